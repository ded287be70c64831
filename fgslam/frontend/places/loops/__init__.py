"""Recognising places: the return to a mapped one, and oneself when lost (Se et al. 7)."""
