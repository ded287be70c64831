"""Smoothers: fixed lag, iSAM2 and batch on one graph builder."""
