"""Every command and option, as `--help` has them: a file each.

After a change that is meant, `python tests/unit/cli/test_help.py` writes the files again.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import pytest
import typer
from typer.testing import CliRunner

from fgslam.cli.main import app
from fgslam.cli.options import FrameOptions, RecordingOptions, command
from scripts.make_reference import commands_of

FOLDER = Path(__file__).with_name("help")


def help_texts() -> Iterator[tuple[str, str]]:
    group = typer.main.get_command(app)
    assert isinstance(group, typer.core.TyperGroup)
    for name, found in commands_of(group):
        lines = [f"fgslam {name}", "", *(found.help or "").splitlines(), ""]
        for one in found.params:
            value = f" {one.metavar}" if one.metavar else ""
            default = "" if one.default in (None, False) else f" [{one.default}]"
            needed = " (required)" if one.required else ""
            text = getattr(one, "help", None) or ""
            lines.append(f"{', '.join(one.opts)}{value}{default}{needed}: {text}")
        yield name.replace(" ", "_"), "\n".join(lines) + "\n"


TEXTS = dict(help_texts())


@pytest.mark.parametrize("name", TEXTS)
def test_help_is_as_it_was(name: str) -> None:
    assert TEXTS[name] == (FOLDER / f"{name}.txt").read_text(encoding="utf-8")


def test_no_help_is_of_a_command_that_is_gone() -> None:
    assert {path.stem for path in FOLDER.iterdir()} == set(TEXTS)


def test_the_help_of_the_viewer_names_the_package_whole() -> None:
    said = CliRunner().invoke(app, ["run", "--help"], env={"COLUMNS": "200"}).stdout
    assert "pip install 'fgslam[viewer]' provides it" in said


def test_a_command_is_made_of_a_function() -> None:
    given = []
    own = typer.Typer()

    @command(own)
    def follow(
        route: Path,
        out: Path,
        frames: FrameOptions,
        jobs: Annotated[int, typer.Option(min=1)] = 1,
        fast: bool = False,
    ) -> None:
        """Follows.

        Args:
            route (ROUTE): which
            out (--to FILE): where
                to
            frames: which are used
            jobs (N): workers
            fast: or not
        """
        given.append((route, out, frames, jobs, fast))

    def status(*arguments: str) -> int:
        return CliRunner().invoke(own, arguments).exit_code

    assert status("a", "--to", "b", "--stop", "3", "--set", "x=1", "--set", "y=2", "--fast") == 0
    expected = FrameOptions(stop=3, overrides=["x=1", "y=2"])
    assert given == [(Path("a"), Path("b"), expected, 1, True)]
    for wrong in (("a",), ("a", "--to", "b", "--jobs", "0"), ("a", "--to", "b", "--no-fast")):
        assert status(*wrong) == 2
    said = CliRunner().invoke(own, ["--help"], env={"COLUMNS": "120"}).stdout
    assert all(words in said for words in ("ROUTE", "which", "--to", "where to", "--jobs", "N"))
    assert "Args" not in said


def test_options_of_a_recording_are_overrides_after_those_that_are_set() -> None:
    chosen = RecordingOptions(
        stop=3, overrides=["a=1"], camera=Path("c.yaml"), scale=0.5, unit=0.001, topics="l, r"
    )
    assert chosen.as_overrides({"map.load": Path("m.fgmap"), "estimator.kind": None}) == [
        *("a=1", "dataset.stop=3", "dataset.scale=0.5", "dataset.unit_m=0.001"),
        *('dataset.topics=["l", "r"]', 'map.load="m.fgmap"'),
    ]


if __name__ == "__main__":
    FOLDER.mkdir(exist_ok=True)
    for name, text in TEXTS.items():
        (FOLDER / f"{name}.txt").write_text(text, encoding="utf-8")
