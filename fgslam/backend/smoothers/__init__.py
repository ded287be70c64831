"""TODO smoothers."""
