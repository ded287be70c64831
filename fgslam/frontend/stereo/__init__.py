"""Matching over two and three cameras."""
