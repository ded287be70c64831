"""Tutorial pages made from the examples, so that what is shown is what the tests run."""

from __future__ import annotations

import re
from pathlib import Path

EXAMPLES = Path(__file__).parents[1] / "examples"
_CELL = re.compile(r"^# %%(?P<kind> \[markdown\])?.*\n", re.MULTILINE)
_NOTE = "<!-- Made by `python -m scripts.make_reference` from examples/{}: edit that. -->"
_END = """Run it: `python examples/{}`. It opens as a notebook in VS Code and (jupytext) in Jupyter.
"""


def tutorial_page(name: str) -> str:
    """The example ``name`` as Markdown: its text, and its code in fenced blocks.

    Raises:
        ValueError: the example does not begin with a text cell and a title.
    """
    source = (EXAMPLES / f"{name}.py").read_text(encoding="utf-8")
    marks = list(_CELL.finditer(source))
    if not marks or marks[0].start() != 0 or not marks[0]["kind"]:
        raise ValueError(f"examples/{name}.py: begin with `# %% [markdown]` and a title")
    ends = [*(mark.start() for mark in marks[1:]), len(source)]
    parts = [
        _cell(source[mark.end() : end].strip(), text=mark["kind"] is not None)
        for mark, end in zip(marks, ends, strict=True)
    ]
    title, _, rest = parts[0].partition("\n")
    head = [title, _NOTE.format(f"{name}.py"), rest.strip()]
    return "\n\n".join([*head, *parts[1:], _END.format(f"{name}.py")])


def _cell(body: str, text: bool) -> str:
    if not text:
        shown = "\n".join(line.replace("  # fmt: skip", "") for line in body.splitlines())
        return f"```python\n{shown}\n```"
    return "\n".join(re.sub(r"^# ?", "", line) for line in body.splitlines())
