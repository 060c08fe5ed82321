"""``python -m tensor_stereo`` is the command ``tensor-stereo``."""

from tensor_stereo.cli import main

if __name__ == "__main__":
    main()
