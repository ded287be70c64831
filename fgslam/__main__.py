"""Runs the command line: ``python -m fgslam`` is ``fgslam``."""

from fgslam.cli.start import main

if __name__ == "__main__":
    main()
