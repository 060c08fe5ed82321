"""Matches to and from the forms of other libraries, one module each; only OpenCV's imports its library."""
