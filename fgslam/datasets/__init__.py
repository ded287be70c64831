"""Readers of recordings, a module for each layout; those of images give the Sequence protocol."""
