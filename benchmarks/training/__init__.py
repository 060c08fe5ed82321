"""What makes the weights and constants that the package ships."""
