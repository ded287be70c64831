"""Readers of recordings, one a module, all behind the Sequence protocol."""
