"""Writes the pages that are made from code: settings, command line, experiments, and tutorials.

Run `python -m scripts.make_reference` from the root of the checkout; a test fails while a page is
stale.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from textwrap import TextWrapper

import typer
from typer.core import TyperArgument, TyperOption

from fgslam.cli.main import app
from scripts.reference_experiments import experiments_page
from scripts.reference_settings import item, paragraph, settings_page

DOCS = Path(__file__).parents[1] / "docs"
EXAMPLES = Path(__file__).parents[1] / "examples"
TUTORIALS = {
    "homing": ("Homing: one vector, then a drive home", ("homing_vector", "drive_home")),
    "own_parts": (
        "Your own parts",
        (
            "own_estimator",
            "own_measurement",
            "own_factors",
            "own_features",
            "own_motion",
            "own_camera",
        ),
    ),
    "live_robot": ("A live robot, with and without ROS 2", ("live_robot", "ros2_node")),
}
"""Tutorials made from several examples: the page's title, and the examples in order."""

LIVE = ("live_robot", "ros2_node")
"""Examples that need a stream of images: they are no notebooks."""

_LINES = TextWrapper(110, drop_whitespace=False, subsequent_indent="    ")
"""What is printed fits a page; spaces stay, for they align tables."""

_CELL = re.compile(r"^# %%(?P<kind> \[markdown\])?.*\n", re.MULTILINE)
_NOTE = "<!-- Made by `python -m scripts.make_reference` from examples/{}: edit that. -->"
_END = """Run it: `python examples/{}` (a notebook in VS Code, by jupytext in Jupyter).
"""
_NOTEBOOK = """Run it: `python examples/{0}.py`; or open
[the notebook](../notebooks/{0}.ipynb), which has these outputs.
"""

_INTRODUCTION = """# Command line

Every command with its arguments and options; what is the same for several is described once.

<!-- Made by `python -m scripts.make_reference` from the program's help: edit that. -->
"""
_STATUS = """
## Exit status

- 0: done; of a comparison: at least one estimator finished.
- 1: no estimator of a comparison finished, or a trial failed.
- 2: a mistake in what was given: one line on standard error says what, where, and how to fix it.
- 3: done, but fewer than half of the frames were located (`run`; `localize`: of the queries).
- 130, 143: ended by Ctrl-C or SIGTERM, within two seconds; all files are valid, `--resume` goes on.

## Memory limit

A command needs 1.2 GB of address space (`ulimit -v`) for its libraries. Open3D, which renders the
lab, needs another 1.3 GB when it is loaded. With a limit below 8 GB, or below 240 MB a core where
that is more, linear algebra works on one thread: those of all cores would fill the limit. Where
memory runs out, one line says so, and the exit status is 2.
"""


def pages() -> dict[str, Callable[[], str]]:
    """What makes each page, by the page's path below docs."""
    made: dict[str, Callable[[], str]] = {
        "reference/settings.md": settings_page,
        "reference/commands.md": commands_page,
        "reference/experiments.md": experiments_page,
    }
    joined = {name for _, names in TUTORIALS.values() for name in names}
    for page in TUTORIALS:
        made[f"tutorials/{page}.md"] = partial(joined_tutorials, page)
    for example in sorted(EXAMPLES.glob("*.py")):
        if example.stem not in joined:
            made[f"tutorials/{example.stem}.md"] = partial(tutorial_page, example.stem)
    return made


def main() -> None:
    """Writes every page."""
    for path, page in pages().items():
        (DOCS / path).write_text(page(), encoding="utf-8")


def commands_page() -> str:
    """The whole page, in Markdown: each command with its arguments and options."""
    group = typer.main.get_command(app)
    if not isinstance(group, typer.core.TyperGroup):
        raise TypeError("fgslam is a group of commands")
    lines = [_INTRODUCTION, *paragraph(group.help or ""), "", "```sh", "fgslam COMMAND --help"]
    lines += ["fgslam --version", "fgslam --install-completion", "```"]
    known = set[str]()
    for name, command in commands_of(group):
        lines += ["", f"## `fgslam {name}`", "", *_described(command, known)]
    return "\n".join(lines) + "\n" + _STATUS


def commands_of(group: typer.core.TyperGroup) -> Iterator[tuple[str, typer.core.TyperCommand]]:
    """Every command by its whole name, those of groups within as well."""
    for name, command in group.commands.items():
        if isinstance(command, typer.core.TyperGroup):
            yield from ((f"{name} {inner}", found) for inner, found in commands_of(command))
        elif isinstance(command, typer.core.TyperCommand):
            yield name, command
        else:
            raise TypeError(f"{name} is no command")


def _described(command: typer.core.TyperCommand, known: set[str]) -> Iterator[str]:
    """Its help and parameters; parameters on the page already by name."""
    alike = []
    for text in (command.help or "").split("\n\n"):
        yield from (*paragraph(text), "")
    for parameter in command.params:
        if not isinstance(parameter, TyperArgument | TyperOption) or parameter.hidden:
            continue
        if parameter.name != "help":
            line = _parameter(parameter)
            if line in known:
                alike.append(line.split(": ")[0])
            else:
                known.add(line)
                yield from item(line)
    yield from item(f"as above: {', '.join(alike)}") if alike else ()


def _parameter(parameter: TyperArgument | TyperOption) -> str:
    names = ", ".join(parameter.opts)
    if isinstance(parameter, TyperArgument):
        return f"`{parameter.metavar or names.upper()}`: {parameter.help or ''}"
    value = f" {parameter.metavar}" if parameter.metavar else ""
    return f"`{names}{value}`: {parameter.help or ''}"


def tutorial_page(name: str) -> str:
    """The example ``name`` as Markdown: its text, and its code in fenced blocks.

    Raises:
        ValueError: the example does not begin with a text cell and a title.
    """
    parts = [_cell(body, text) for body, text in cells_of(name)]
    last = _END.format(f"{name}.py")
    if notebook_of(name).is_file():
        last = _NOTEBOOK.format(name)
        shown = _shown(name)
        parts = [part + shown.get(k, "") for k, part in enumerate(parts)]
    title, _, rest = parts[0].partition("\n")
    head = [title, _NOTE.format(f"{name}.py"), rest.strip()]
    return "\n\n".join([*head, *parts[1:], last])


def cells_of(name: str) -> list[tuple[str, bool]]:
    """The cells of an example, and whether each is text. Raises ValueError without a first one."""
    source = (EXAMPLES / f"{name}.py").read_text(encoding="utf-8")
    marks = list(_CELL.finditer(source))
    if not marks or marks[0].start() != 0 or not marks[0]["kind"]:
        raise ValueError(f"examples/{name}.py: begin with `# %% [markdown]` and a title")
    ends = [*(mark.start() for mark in marks[1:]), len(source)]
    return [
        (source[mark.end() : end].strip(), mark["kind"] is not None)
        for mark, end in zip(marks, ends, strict=True)
    ]


def notebook_of(name: str) -> Path:
    """Where the notebook of an example is kept."""
    return DOCS / "notebooks" / f"{name}.ipynb"


def picture_of(name: str) -> Path:
    """Where the picture that an example draws is kept."""
    return DOCS / "images" / f"example_{name}.png"


def _shown(name: str) -> dict[int, str]:
    """What each cell of a notebook prints, in a fenced block, and its picture, by its number."""
    out: dict[int, str] = {}
    for k, cell in enumerate(json.loads(notebook_of(name).read_text(encoding="utf-8"))["cells"]):
        outputs = cell.get("outputs", ())
        texts = ["".join(one.get("text", "")) for one in outputs]
        lines = [
            part.rstrip()
            for line in "".join(texts).splitlines()
            for part in _LINES.wrap(line) or [""]
        ]
        if lines:
            out[k] = "\n".join(["\n\n```text", *lines, "```"])
        if any("data" in one for one in outputs):
            out[k] = f"{out.get(k, '')}\n\n![What it draws](../images/{picture_of(name).name})"
    return out


def joined_tutorials(page: str) -> str:
    """The examples of one page of :data:`TUTORIALS` one after the other, a section each."""
    title, names = TUTORIALS[page]
    text = "\n".join(tutorial_page(name) for name in names)
    parts = text.split("```")  # every second one is code, where `#` begins a comment
    parts[::2] = [re.sub(r"^#", "##", part, flags=re.MULTILINE) for part in parts[::2]]
    return f"# {title}\n\n" + "```".join(parts)


def _cell(body: str, text: bool) -> str:
    if not text:
        shown = "\n".join(line.replace("  # fmt: skip", "") for line in body.splitlines())
        return f"```python\n{shown}\n```"
    return "\n".join(re.sub(r"^# ?", "", line) for line in body.splitlines())


if __name__ == "__main__":
    main()
