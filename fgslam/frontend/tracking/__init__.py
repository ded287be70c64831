"""Tracking against the map: landmark database, map matching, ego-motion."""
