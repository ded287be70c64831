"""docs/reference/settings.md says what the schema says."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import pytest

from fgslam.runs.config import ExperimentConfig
from fgslam.runs.config_models import HOMING_TASKS, TASKS, LocalisationConfig

ROOT = Path(__file__).parents[3]


@pytest.fixture(scope="module")
def maker() -> ModuleType:
    path = ROOT / "scripts" / "make_configuration_docs.py"
    spec = importlib.util.spec_from_file_location("make_configuration_docs", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_page_is_current(maker: ModuleType) -> None:
    page = (ROOT / "docs" / "reference" / "settings.md").read_text(encoding="utf-8")
    assert page == maker.configuration_page(), "stale: run scripts/make_configuration_docs.py"


def test_every_key_and_kind_is_on_the_page(maker: ModuleType) -> None:
    page = maker.configuration_page()
    schema = ExperimentConfig.model_json_schema()
    for group in schema["$defs"].values():
        for name, node in group.get("properties", {}).items():
            if name == "kind":
                assert f"kind `{node['const']}`" in page
            else:
                assert f"| `{name}` |" in page or f".{name}`" in page, name


@pytest.mark.parametrize("task", HOMING_TASKS)
def test_every_key_of_every_homing_task_is_on_the_page(maker: ModuleType, task: str) -> None:
    page = maker.configuration_page()
    assert f"### Task `{task}`" in page
    schema = TASKS[task].model_json_schema()
    for group in (schema, *schema["$defs"].values()):
        for name, node in group.get("properties", {}).items():
            if name == "kind":
                assert f"kind `{node['const']}`" in page
            elif name not in ("task", "provenance"):
                assert f"| `{name}` |" in page or f"{name}`" in page, name


def test_every_key_of_localisation_is_on_the_page(maker: ModuleType) -> None:
    page = maker.configuration_page()
    assert "## Task `localisation`" in page
    schema = LocalisationConfig.model_json_schema()
    for group in ("KnownMapSettings", "QuerySettings"):
        for name in schema["$defs"][group]["properties"]:
            assert f"| `{name}` |" in page, name


def test_a_row_holds_range_default_and_meaning(maker: ModuleType) -> None:
    page = maker.configuration_page()
    assert "| `seed` | whole number >= 0 | `0` | of everything random in the run |" in page
    assert "| `path` | text |  | folder of the recording |" in page
    assert '| `mode` | `descriptor` or `paper` | `"descriptor"` |' in page
    assert "| `ratio` | number <= 1, > 0 |" in page or "| `ratio` | number > 0, <= 1 |" in page
