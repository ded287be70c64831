"""Simulated measurements without images: landmark drives and homings of bearings."""
