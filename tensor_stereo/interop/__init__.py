"""Matches to and from the forms of other libraries and files, one module each; h5py and pycolmap load when needed."""
