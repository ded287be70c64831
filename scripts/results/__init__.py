"""The evidence behind docs/results.md: `python -m scripts.results WHAT [--out FILE.json]`."""
