"""The decorator that every group of settings shares."""

from __future__ import annotations

from pydantic import ConfigDict

STRICT = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
"""Unknown keys, NaN and infinity are refused; values cannot change once read."""
