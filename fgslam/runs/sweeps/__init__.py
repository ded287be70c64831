"""Sweeps: experiments over settings, recordings, estimators and seeds, on many workers."""
