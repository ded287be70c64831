"""Makes Markdown of the cross-references in docstrings, for the reference pages."""

from __future__ import annotations

import re
from typing import Any

import griffe

_ROLE = re.compile(r":[a-z]+:`~?([^`]+)`")
_CODE_FOLLOWS = re.compile(r"::$", re.MULTILINE)


def as_markdown(text: str) -> str:
    """The docstring with ``:class:`a.b.C``` as `C`, and code blocks announced by a colon."""
    named = _ROLE.sub(lambda role: f"`{role.group(1).rpartition('.')[2]}`", text)
    named = re.sub(r"\n::\n", "\n", named)
    return _CODE_FOLLOWS.sub(":", named.replace("``", "`"))


class Roles(griffe.Extension):
    """Rewrites every docstring that is loaded."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Called by griffe for each object."""
        if obj.docstring is not None:
            obj.docstring.value = as_markdown(obj.docstring.value)
