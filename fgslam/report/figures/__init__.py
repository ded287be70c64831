"""Figures as plotly traces in plain values, made of plain arrays; pages and PNGs show them."""
