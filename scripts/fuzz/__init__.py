"""Damaged and odd inputs by the thousand: `make fuzz`, or `python -m scripts.fuzz --help`.

Each case is made from a seed and handed to what reads such an input. It has to be read, or refused
by one line. Counted as faults: other exceptions, more than ten seconds, more than two gigabytes, a
refusal of several lines, and bytes that were changed and read as other values without a word.
"""

import os

os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")  # both are read when OpenCV is imported
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
