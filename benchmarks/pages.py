"""Pages of results under docs/results, made from the committed measurements."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path

from benchmarks.curves import IMAGES, PICTURES
from benchmarks.measured import stored
from benchmarks.rows import RESULTS, Record, Row, Section, load_record, shown_bound, shown_number
from benchmarks.tables import Cell, Table, grid, shown

PAGES = Path(__file__).parents[1] / "docs" / "results"
README = Path(__file__).parents[1] / "README.md"
WIDTH = 118
_NOTE = "<!-- Made by `python -m benchmarks pages` from benchmarks/results/{}.json: edit that. -->"
_BY_HAND = "by hand"
_MISSED = ", **missed**"

SUBJECTS: dict[str, tuple[str, tuple[str, ...]]] = {
    "mapping": (
        "Mapping and localisation",
        ("paper_drive", "real_recordings", "three_cameras", "moving_person", "ablations"),
    ),
    "filter_or_smoother": ("Filter or smoother", ("filter_or_smoother",)),
    "robustness": ("Robustness", ("robustness", "nothing_lost")),
    "maps": ("Maps", ("dense_maps", "lasting_landmarks", "saved_maps", "relocalisation", "loops")),
    "homing": ("Homing", ("homing_vectors", "homing_drives", "homing_estimators")),
    "routes": ("Routes", ("own_routes", "topological_maps")),
    "speed": ("Speed", ("key_frames", "speed")),
}
"""Pages in the order of the site: the title, and the files of measurements on it."""


def write_pages(results: Path = RESULTS, folder: Path = PAGES) -> None:
    """Writes one page a subject, the overview, its pictures, and the numbers in README."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in all_pages(results).items():
        (folder / f"{name}.md").write_text(text, encoding="utf-8")
    for name, draw in PICTURES.items():
        draw(IMAGES / name)
    README.write_text(readme(README.read_text(encoding="utf-8")), encoding="utf-8")


def all_pages(results: Path = RESULTS) -> dict[str, str]:
    """Text of every page by its name; ``index`` is the overview."""
    records = {
        subject: [load_record(results / f"{name}.json") for name in names]
        for subject, (_, names) in SUBJECTS.items()
    }
    pages = {name: page(SUBJECTS[name][0], found) for name, found in records.items()}
    return pages | {"index": overview(records)}


def readme(text: str) -> str:
    """README with the tables between its marks made anew from what is stored."""
    before, rest = text.split(_BEGIN)
    after = rest.split(_END)[1]
    peers, lab = stored("peers"), stored("lab_loop").numbers["estimators"]
    lines = grid(_BESIDE, _of_peers(peers.numbers["Beside other programs"]))
    told = "; ".join(_of_lab(lab))
    lines += ["", *_wrapped(f"The paper's drive, rendered, 249 frames, ATE and NEES: {told}.")]
    return f"{before}{_BEGIN}\n\n" + "\n".join(lines) + f"\n\n{_END}{after}"


_BEGIN = "<!-- numbers: `python -m benchmarks pages` makes them -->"
_END = "<!-- end of numbers -->"
_BESIDE = (
    "no odometry, SE(3) aligned", "fgslam: live, end", "NEES", "ORB-SLAM3: live, end",
    "CPU of the command / ORB-SLAM3's",
)  # fmt: skip


def _of_lab(estimators: Mapping[str, Mapping[str, float]]) -> Iterator[str]:
    for name, values in estimators.items():
        ate, nees = 100.0 * values["ate_rmse_m"], values.get("nees_pose_per_dof")
        yield f"{name} {shown(ate)} cm, {shown(nees)}"


def _of_peers(columns: Mapping[str, Sequence[Cell]]) -> Iterator[tuple[str, ...]]:
    """A line for each recording as it is: fgslam's default beside ORB-SLAM3."""
    rows = {
        (str(recording), str(program)): {name: columns[name][k] for name in columns}
        for k, (recording, program) in enumerate(
            zip(columns["recording"], columns["program"], strict=True)
        )
    }
    for (recording, program), ours in rows.items():
        theirs = rows.get((recording, "ORB-SLAM3"))
        if program != "fgslam" or "," in recording or theirs is None:
            continue
        yield (
            f"`{recording}`", _both(ours), shown(ours["NEES"]), _both(theirs),
            shown(ours["CPU / ORB-SLAM3's"]),
        )  # fmt: skip


def _both(row: Mapping[str, Cell]) -> str:
    live, end = row["ATE live"], row["ATE end"]
    if live is None:
        return "lost"
    reached = (
        f"{shown(live)} m, none at the end" if end is None else f"{shown(live)}, {shown(end)} m"
    )
    return f"{reached} ({row['located']})"


def overview(records: Mapping[str, Sequence[Record]]) -> str:
    """How many bounds each subject has and how many are met, then every one that is missed."""
    rows = [row for found in records.values() for record in found for row in record.rows]
    missed = sum(row.met is False for row in rows)
    lines = [
        "# Results",
        "",
        "<!-- Made by `python -m benchmarks pages`. -->",
        "",
        *_wrapped(
            f"{len(rows)} bounds, {len(rows) - missed} met, {missed} missed. Each page gives the "
            "numbers, their bounds and the commands that measure them; slow tests hold most "
            "bounds. Images measured before 2026-11-25 had SIFT on every frame "
            "(`frontend.tracking: sift`); since then [key frames](speed.md) are the default."
        ),
    ]
    for subject, found in records.items():
        lines += ["", f"## [{SUBJECTS[subject][0]}]({subject}.md)", "", *map(_counted, found)]
    missing = [line for found in records.values() for record in found for line in _missed(record)]
    lines += ["", "## Missed", "", *(missing or ["None."])]
    return _joined(lines)


def _counted(record: Record) -> str:
    met = sum(row.met is True for row in record.rows)
    of = len(record.rows)
    return f"- {record.title}" + (f": {met} of {of} bounds met" if of else "")


def _missed(record: Record) -> Iterator[str]:
    """An item: what the record misses, the number and its bound."""
    rows = [row for row in record.rows if row.met is False]
    listed = "; ".join(f"{row.name}: {shown_number(row)} ({shown_bound(row)})" for row in rows)
    if rows:
        first, *others = _wrapped(f"- {record.title}: {listed}")
        yield from (first, *(f"  {line}" for line in others))


def page(title: str, records: Sequence[Record]) -> str:
    """One page: each section with its command, bounds and tables; a chapter a record."""
    lines = [f"# {title}"]
    for record in records:
        mark = "##" if len(records) > 1 else "#"
        if len(records) > 1:
            lines += ["", f"## {record.title}"]
        lines += ["", _NOTE.format(record.name)]
        for paragraph in (*record.text, *_when(record)):
            lines += ["", *_wrapped(paragraph)]
        for section in record.sections:
            lines += ["", f"{mark}# {section.title}", "", *_section(section)]
    return _joined(lines)


def _section(section: Section) -> Iterator[str]:
    for paragraph in (*section.text, *_stored(section)):
        yield from (*_wrapped(paragraph), "")
    if section.commands:
        yield from ("```sh", *_continued(section.commands), "```", "")
    for name, shows in section.pictures.items():
        yield from (f"![{shows}](../images/{name})", "")
    mixed = any(section.sources)
    if section.rows:
        yield from (*_bounds(section.rows, mixed), "")
    for table in section.tables:
        marked = f" ({_BY_HAND})" if mixed and "" in table.sources else ""
        if table.title or marked:
            yield from (f"**{table.title}{marked}**".replace("** (", "**("), "")
        yield from (*fitted(table), "")
        for note in table.notes:
            yield from (*_wrapped(note), "")


def _when(record: Record) -> Iterator[str]:
    """When the numbers were measured that a person wrote down; nothing where there are none."""
    sources = [section.sources for section in record.sections]
    if not all(found and all(found) for found in sources):
        rest = " unless stated otherwise" if any(map(any, sources)) else ""
        yield f"Measured {_BY_HAND} on {record.date} with fgslam {record.version}{rest}."


def _stored(section: Section) -> Iterator[str]:
    """The stored measurements that the page computes a section's numbers from."""
    files = ", ".join(f"`{name}` ({stored(name).date})" for name in section.sources if name)
    if files:
        yield f"Computed from `benchmarks/measured`: {files}."


def _bounds(rows: Iterable[Row], mixed: bool) -> list[str]:
    """Numbers beside their bounds, the missed ones marked, as a Markdown table."""
    cells = [
        (
            r.name,
            shown_number(r) + (f" ({_BY_HAND})" if mixed and not r.source else ""),
            shown_bound(r) + (_MISSED if r.met is False else ""),
        )
        for r in rows
    ]
    return grid(("", "measured", "bound"), cells)


def fitted(table: Table, width: int = WIDTH) -> list[str]:
    """The table in Markdown, turned on its side or cut into several where it is too wide."""
    cells = [tuple(map(_cell, row)) for row in table.rows]
    lines = grid(table.columns, cells)
    if _width(lines) <= width:
        return lines
    turned = list(zip(table.columns, *cells, strict=True))
    lines = grid(turned[0], turned[1:])
    if _width(lines) <= width:
        return lines
    return _cut(table.columns, cells, width)


def _cut(columns: Sequence[str], rows: list[tuple[str, ...]], width: int) -> list[str]:
    """Several tables below each other, each beginning with the first column."""
    parts: list[list[int]] = [[]]
    for k in range(1, len(columns)):
        if parts[-1] and _width(_picked(columns, rows, [*parts[-1], k])) > width:
            parts.append([])
        parts[-1].append(k)
    lines = [line for part in parts for line in (*_picked(columns, rows, part), "")][:-1]
    if _width(lines) > width:
        raise ValueError(f"a column of the table {columns} is wider than {width} characters")
    return lines


def _picked(columns: Sequence[str], rows: list[tuple[str, ...]], part: list[int]) -> list[str]:
    keep = [0, *part]
    return grid([columns[k] for k in keep], [[row[k] for k in keep] for row in rows])


def _cell(cell: Cell) -> str:
    return "" if cell is None else shown(cell)


def _width(lines: Iterable[str]) -> int:
    return max(map(len, lines))


def _wrapped(paragraph: str) -> list[str]:
    return textwrap.wrap(paragraph, WIDTH, break_long_words=False, break_on_hyphens=False)


def _continued(commands: Iterable[str]) -> Iterator[str]:
    """Commands as a shell reads them, long ones on several lines."""
    for command in commands:
        whole = command.replace("--set ", "--set\0")  # an option stays with its value
        cut = textwrap.wrap(whole, WIDTH - 6, break_long_words=False, break_on_hyphens=False)
        lines = [line.replace("\0", " ") for line in cut]
        yield from (f"{'    ' if k else ''}{line} \\" for k, line in enumerate(lines[:-1]))
        yield f"{'    ' if len(lines) > 1 else ''}{lines[-1]}"


def _joined(lines: Iterable[str]) -> str:
    return "\n".join(line.rstrip() for line in lines).rstrip() + "\n"
