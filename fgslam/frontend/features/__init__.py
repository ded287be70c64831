"""Features: SIFT (grey and colour), column segments, descriptors and their matching."""
