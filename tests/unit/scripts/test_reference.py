"""The generated reference pages say what the code says."""

from __future__ import annotations

import base64
import json
import re

import pytest
import typer

from fgslam.cli.main import app
from fgslam.runs.config import HOMING_TASKS, TASKS, ExperimentConfig
from scripts import reference_experiments, reference_settings
from scripts.make_reference import (
    DOCS,
    EXAMPLES,
    LIVE,
    cells_of,
    commands_of,
    commands_page,
    notebook_of,
    pages,
    picture_of,
)
from scripts.make_tutorial_pictures import LARGEST
from scripts.reference_experiments import unreasoned
from scripts.reference_settings import WIDTH, item, settings_page

PAGES = pages()


@pytest.fixture(scope="module")
def page() -> str:
    return settings_page()


@pytest.mark.parametrize("path", PAGES)
def test_committed_page_is_current(path: str) -> None:
    text = (DOCS / path).read_text(encoding="utf-8")
    assert text == PAGES[path](), "stale: run python -m scripts.make_reference"


@pytest.mark.parametrize("path", PAGES)
def test_lines_fit(path: str) -> None:
    assert max(map(len, PAGES[path]().splitlines())) <= WIDTH


def test_no_experiment_tunes_what_the_defaults_settle() -> None:
    """Features, matching, ego-motion: a setting of an experiment needs a reason on the page."""
    assert unreasoned() == []


def test_a_number_that_is_tuned_to_a_recording_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    tuned = {"dataset": {"kind": "euroc"}, "frontend": {"sift": {"base_sigma_px": 2.0}}}
    others = {"dataset": {"kind": "euroc"}, "compare": [{"kind": "isam2", "gate_px": 3.0}]}
    files = [("walk", tuned), ("flight", others), ("se_lowe_little_2001", tuned)]
    monkeypatch.setattr(reference_experiments, "slam_experiments", lambda: iter(files))
    assert unreasoned() == ["walk: frontend.sift.base_sigma_px", "flight: compare.gate_px"]


def test_no_tutorial_stands_without_its_example() -> None:
    pages = (DOCS / "tutorials").glob("*.md")
    made = {f"tutorials/{page.name}" for page in pages if "<!-- Made by" in page.read_text("utf-8")}
    assert made == {path for path in PAGES if path.startswith("tutorials/")}


def test_every_key_and_kind_is_on_the_page(page: str) -> None:
    schema = ExperimentConfig.model_json_schema()
    for group in schema["$defs"].values():
        for name, node in group.get("properties", {}).items():
            if name == "kind":
                assert f"kind `{node['const']}`" in page
            else:
                assert f"- `{name}` (" in page or f".{name}`" in page, name


@pytest.mark.parametrize("task", HOMING_TASKS)
def test_every_key_of_every_homing_task_is_on_the_page(page: str, task: str) -> None:
    assert f"### Task `{task}`" in page
    schema = TASKS[task].model_json_schema()
    for group in (schema, *schema["$defs"].values()):
        for name, node in group.get("properties", {}).items():
            if name == "kind":
                assert f"kind `{node['const']}`" in page
            elif name not in ("task", "provenance"):
                assert f"- `{name}` (" in page or f"{name}`" in page, name


def test_item_holds_range_default_and_meaning(page: str) -> None:
    assert "- `seed` (`0`, >= 0): of everything random in the run" in page
    assert "- `path` (required): folder of the recording" in page
    assert "- `stop` (`null`, integer >= 1): " in page
    assert "- `baseline_m` (`0.1`, (0, 2]): right to left camera" in page
    assert '- `mode` (`"descriptor"`, `"paper"`):' in page


def test_keys_that_groups_have_alike_are_described_once_and_named_again(page: str) -> None:
    assert page.count("- `stride` (") == 1
    euroc = page.split("## `dataset`, kind `euroc`", 1)[1].split("\n## ", 1)[0]
    assert re.search(r"- alike: .*`camera_file`", euroc)


def test_keys_that_matter_first_exist(page: str) -> None:
    keys = [key for names in reference_settings.FIRST for key in names.split(", ")]
    assert len(reference_settings.FIRST) == 10
    for key in keys:
        group, _, name = key.rpartition(".")
        assert not group or f"`{group}`" in page, key
        assert f"- `{name}` (" in page or f"`{key}`, kind" in page or name == "kind", key


def test_every_command_and_option_is_on_the_page() -> None:
    page = commands_page()
    group = typer.main.get_command(app)
    assert isinstance(group, typer.core.TyperGroup)
    found = dict(commands_of(group))
    assert {"run", "camera show", "camera convert"} <= found.keys()
    for name, command in found.items():
        section = re.split(r"\n## ", page.split(f"## `fgslam {name}`\n", 1)[1])[0]
        for parameter in command.params:
            hidden = getattr(parameter, "hidden", False)
            if parameter.param_type_name == "option" and parameter.name != "help" and not hidden:
                assert f"`{parameter.opts[0]}" in section, (name, parameter.opts)


def test_items_break_between_words_but_not_in_code() -> None:
    lines = item("`a key with a long name`: " + "word " * 40)
    assert max(map(len, lines)) <= WIDTH
    assert lines[0].startswith("- `a key with a long name`: word")
    assert lines[1].startswith("  word")


@pytest.mark.parametrize("name", sorted({p.stem for p in EXAMPLES.glob("*.py")} - {*LIVE}))
def test_the_notebook_of_an_example_has_its_code_what_it_prints_and_its_picture(name: str) -> None:
    cells = json.loads(notebook_of(name).read_text(encoding="utf-8"))["cells"]
    code = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
    stale = f"stale: run python -m scripts.make_notebooks {name}"
    assert code == [body for body, text in cells_of(name) if not text], stale
    outputs = [one for cell in cells for one in cell.get("outputs", ())]
    assert any(one.get("name") == "stdout" for one in outputs)
    drawn = [base64.b64decode(one["data"]["image/png"]) for one in outputs if "data" in one]
    assert drawn == [picture_of(name).read_bytes()], stale
    assert len(drawn[0]) < LARGEST
