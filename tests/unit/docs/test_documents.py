"""The documents: lines that fit, words of the field, files that exist, pages in the navigation."""

from __future__ import annotations

import re
from importlib import import_module
from pathlib import Path

import pytest

import fgslam

ROOT = Path(__file__).parents[3]
PAGES = sorted((ROOT / "docs").rglob("*.md"))
EVERY = [*PAGES, *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md"))]
ids = [str(page.relative_to(ROOT)) for page in EVERY]

CODES = re.compile(r"\b(E-[GS]\d+|[SG]\d{1,2}|[BD]\d)\b")
WORDS = re.compile(r"\b(doctors?|strangers?|witness(es)?|rivals?|twins?|amid)\b", re.IGNORECASE)
FOLDERS = "fgslam|experiments|tests|docs|examples|benchmarks|scripts"
MODULES = [str(path) for top in FOLDERS.split("|") for path in (ROOT / top).rglob("*.py")]
NAVIGATION = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")


def prose(page: Path) -> str:
    """Text of a page without code."""
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    return re.sub(r"`[^`]*`|\]\([^)]*\)", "", text)


@pytest.mark.parametrize("page", EVERY, ids=ids)
def test_lines_fit_a_screen(page: Path) -> None:
    lines = page.read_text(encoding="utf-8").splitlines()
    long = [f"{page}:{k}: {len(line)}" for k, line in enumerate(lines, 1) if len(line) > 120]
    assert not long


@pytest.mark.parametrize("page", EVERY, ids=ids)
def test_words_are_those_of_the_field(page: Path) -> None:
    text = prose(page)
    assert not CODES.findall(text)
    assert not [found.group() for found in WORDS.finditer(text)]


def test_changelog_names_the_version_that_is_made_and_no_release_of_that_version() -> None:
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    released = re.findall(r"^## \[(\d[^]]*)\] - \d{4}-\d{2}-\d{2}$", text, flags=re.MULTILINE)
    towards = re.findall(r"^Towards (\d[\w.]*\d): ", text, flags=re.MULTILINE)
    assert towards == [fgslam.__version__.partition(".dev")[0]]
    assert "0.1.0" in released
    assert fgslam.__version__ not in released


@pytest.mark.parametrize("page", PAGES, ids=ids[: len(PAGES)])
def test_page_is_in_the_navigation(page: Path) -> None:
    assert str(page.relative_to(ROOT / "docs")) in NAVIGATION


@pytest.mark.parametrize("page", EVERY, ids=ids)
def test_files_that_a_page_names_exist(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    named = set(re.findall(rf"\b(?:{FOLDERS})/[a-z0-9_/.]*\.(?:py|yaml|md|json|sh|npz)", text))
    assert not [name for name in sorted(named) if not (ROOT / name).is_file()]


def test_every_room_is_in_the_architecture() -> None:
    page = (ROOT / "docs/concepts/architecture.md").read_text(encoding="utf-8")
    rooms = [p.name for p in (ROOT / "fgslam").iterdir() if (p / "__init__.py").is_file()]
    assert len(rooms) >= 10
    for room in rooms:
        assert f"| `{room}` |" in page, room


def test_every_file_of_the_architecture_s_table_exists() -> None:
    page = (ROOT / "docs/concepts/architecture.md").read_text(encoding="utf-8")
    table = page.split("## Where is what", 1)[1].split("\n## ", 1)[0]
    rows = [line.split("|")[2] for line in table.splitlines() if line.startswith("| ")][1:]
    assert len(rows) > 15
    for row in rows:
        first, *rest = re.findall(r"`([^`]+)`", row)
        folder = Path(first).parent
        for name in (first, *rest):
            path = name if "/" in name or name == first else str(folder / name)
            assert (ROOT / "fgslam" / path).exists(), path


def test_every_public_name_is_in_the_reference() -> None:
    page = (ROOT / "docs/reference/api.md").read_text(encoding="utf-8")
    shown = set(re.findall(r"^::: fgslam\.(\w+)$", page, flags=re.MULTILINE))
    assert shown == set(fgslam.__all__) - {"__version__", "errors"}


@pytest.mark.parametrize("page", EVERY, ids=ids)
def test_modules_that_a_page_names_exist(page: Path) -> None:
    if page.name == "CHANGELOG.md":  # names what has been
        return
    text = page.read_text(encoding="utf-8")
    named = {f"/{name}" for name in re.findall(r"`([A-Za-z0-9_/]+\.py)`", text)}
    rooms = set(re.findall(r"`(fgslam/[a-z0-9_/]*)`", text))
    stale = [name for name in named if not any(path.endswith(name) for path in MODULES)]
    stale += [room for room in rooms if not (ROOT / room).is_dir()]
    assert not sorted(stale)


@pytest.mark.parametrize("page", EVERY, ids=ids)
def test_dotted_names_on_a_page_can_be_imported(page: Path) -> None:
    if page.name == "CHANGELOG.md":  # names what has been
        return
    text = page.read_text(encoding="utf-8")
    names = sorted(set(re.findall(r"`(fgslam(?:\.[A-Za-z_]\w*)+)`", text)))
    assert not [name for name in names if not is_importable(name)]


def is_importable(name: str) -> bool:
    """Whether a module, or a name in one, or an attribute of such a name, is there."""
    parts = name.split(".")
    for end in range(len(parts), 0, -1):
        try:
            found: object = import_module(".".join(parts[:end]))
        except ImportError:
            continue
        for attribute in parts[end:]:
            if not hasattr(found, attribute):
                return False
            found = getattr(found, attribute)
        return True
    return False
