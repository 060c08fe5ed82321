"""What filtered matches are worth elsewhere; nothing here is part of the package."""
