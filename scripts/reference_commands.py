"""The page of the command line, made from the program's own help."""

from __future__ import annotations

from collections.abc import Iterator

import typer
from typer.core import TyperArgument, TyperOption

from fgslam.cli.main import app
from scripts.markdown import item, paragraph

_INTRODUCTION = """# Command line

<!-- Made by `python -m scripts.make_reference` from the program's help: edit that. -->
"""
_STATUS = """
## Exit status

- 0: done; of a comparison: at least one estimator finished.
- 1: no estimator of a comparison finished, a trial failed, or a baseline got worse.
- 2: a mistake in what was given: one line on standard error says what, where, and how to fix it.
- 130: interrupted; the run folder holds everything computed so far.
"""


def commands_page() -> str:
    """The whole page, in Markdown: each command with its arguments and options."""
    group = typer.main.get_command(app)
    if not isinstance(group, typer.core.TyperGroup):
        raise TypeError("fgslam is a group of commands")
    lines = [_INTRODUCTION, *paragraph(group.help or ""), "", "```sh", "fgslam COMMAND --help"]
    lines += ["fgslam --version", "fgslam --install-completion", "```"]
    for name, command in group.commands.items():
        if not isinstance(command, typer.core.TyperCommand):
            raise TypeError(f"{name} is no command")
        lines += ["", f"## `fgslam {name}`", "", *_described(command)]
    return "\n".join(lines) + "\n" + _STATUS


def _described(command: typer.core.TyperCommand) -> Iterator[str]:
    for text in (command.help or "").split("\n\n"):
        yield from (*paragraph(text), "")
    for parameter in command.params:
        if isinstance(parameter, TyperArgument | TyperOption) and parameter.name != "help":
            yield from item(_parameter(parameter))


def _parameter(parameter: TyperArgument | TyperOption) -> str:
    names = ", ".join(parameter.opts)
    if isinstance(parameter, TyperArgument):
        return f"`{parameter.metavar or names.upper()}`: {parameter.help or ''}"
    value = f" {parameter.metavar}" if parameter.metavar else ""
    return f"`{names}{value}`: {parameter.help or ''}"
