"""Stereo matching over two and three cameras."""
