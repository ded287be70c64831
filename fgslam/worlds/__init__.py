"""Rendered worlds with exact truth."""
