"""The page of any task: one HTML file that needs no other file and no network.

A jinja2 template with automatic escaping; the page's own policy lets only the two scripts run whose
digests it names, so that not even a mistake here would run a script in a configuration or a
file name. Plotly and the figures are compressed: the browser unpacks them.
"""

from __future__ import annotations

import base64
import gzip
import hashlib
import io
import json
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import lru_cache
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from fgslam.core.files import cache_root, cached, keep_cached, write_text
from fgslam.report import figures as drawn
from fgslam.report.content import Drive, Page, Picture, metres, plain
from fgslam.report.results import EstimatorReport, ReportData

MAX_WIDTH = 1100
BUDGET_BYTES = 440_000
"""Of all pictures together, so that a page with its plots stays below three megabytes."""
_TOO_MUCH = "Left out to keep this page small, see the run folder"
_KEPT_AS_IT_IS = 40_000
_QUALITY = 55
_ASSETS = resources.files(__package__) / "templates"
_DRAW = (_ASSETS / "draw.js").read_text(encoding="utf-8")


def write_html(path: Path, page: Page) -> None:
    """Writes the page atomically; the same values give the same bytes.

    Args:
        path: the .html file.
        page: all that it shows.

    Raises:
        OutputError: the file cannot be written.
    """
    write_text(path, render(page))


def render(page: Page) -> str:
    """The page as text."""
    import jinja2  # what draws no page needs none

    environment = jinja2.Environment(
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        undefined=jinja2.StrictUndefined,
    )
    shown, left_out = embed(page.pictures)
    plotly, digest = _plotly()
    drawings = (
        f"{json.dumps(one.key)}: {one.drawing.to_json(engine='json')}"
        for one in page.figures
        if one.has_numbers
    )
    return environment.from_string((_ASSETS / "page.html").read_text(encoding="utf-8")).render(
        page=page,
        pictures=shown,
        left_out=left_out,
        style=(_ASSETS / "page.css").read_text(encoding="utf-8"),
        draw=_DRAW,
        digests=(digest, _digest(_DRAW)),
        plotly=plotly,
        figures=_packed(f'{{"figures": {{{", ".join(drawings)}}}, "drive": {_moves(page.drive)}}}'),
    )


def _moves(drive: Drive | None) -> str:
    """A drive as JSON; places to the millimetre, to keep the page small."""
    if drive is None:
        return "null"
    return json.dumps(
        plain(
            {
                "colours": drive.colours,
                "seconds": drive.seconds.round(3),
                "places": drive.places.round(3),
                "views": [
                    [step, f"data:image/jpeg;base64,{base64.b64encode(view).decode('ascii')}"]
                    for step, view in drive.views.items()
                ],
            }
        )
    )


@lru_cache(maxsize=1)
def _plotly() -> tuple[str, str]:
    """Plotly's script, packed, and the digest under which the page lets it run; both cached."""
    import plotly
    from plotly.offline import get_plotlyjs

    ground = plotly.__version__ + Path(__file__).read_text(encoding="utf-8")
    file = cache_root() / "page" / f"plotly-{hashlib.sha256(ground.encode()).hexdigest()[:20]}"
    kept = cached(file)
    if kept is None:
        # As the browser's parser hands a script on, so that its digest is the same there.
        script = str(get_plotlyjs()).replace("\r\n", "\n").replace("\r", "\n")
        kept = (_digest(script) + _packed(script)).encode("utf-8")
        keep_cached(file, kept)
    both, digits = kept.decode("utf-8"), len(_digest(""))
    return both[digits:], both[:digits]


def _packed(text: str) -> str:
    """Text as gzip, seven bits a character, without a date, so that equal texts give equal bytes.

    An eighth shorter than base64. What a browser's parser does not hand on as it is has a bit more,
    which `draw.js` cuts off.
    """
    content = gzip.compress(text.encode("utf-8"), compresslevel=6, mtime=0)
    bits = np.unpackbits(np.frombuffer(content, np.uint8))
    groups = np.pad(bits, (0, -len(bits) % 7)).reshape(-1, 7)
    codes = np.packbits(groups, axis=1) >> 1
    packed = codes.tobytes().decode("ascii")
    return packed.replace("\0", "\u0100").replace("\r", "\u010d").replace("<", "\u013c")


def _digest(script: str) -> str:
    return base64.b64encode(hashlib.sha256(script.encode("utf-8")).digest()).decode("ascii")


def embed(pictures: Sequence[Picture]) -> tuple[list[dict[str, Any]], list[str]]:
    """Pictures as data URIs with caption, width and height, and a line about each not shown.

    Large ones are made smaller; later ones are left out when the budget of bytes is used up.
    """
    from PIL import Image, UnidentifiedImageError  # what draws no page needs none

    shown: list[dict[str, Any]] = []
    left_out: list[str] = []
    spent = 0
    for picture in pictures:
        content = picture.content
        try:
            with Image.open(io.BytesIO(content)) as opened:
                opened.load()  # a truncated file is found only now
                (width, height), kind = opened.size, opened.format
                if len(content) > _KEPT_AS_IT_IS or kind not in ("PNG", "JPEG", "WEBP"):
                    # WEBP takes thirty times the time for a quarter fewer bytes.
                    small, kind, out = opened.convert("RGB"), "JPEG", io.BytesIO()
                    small.thumbnail((MAX_WIDTH, height), Image.Resampling.BILINEAR)
                    small.save(out, format=kind, quality=_QUALITY)
                    content = out.getvalue()
        except (UnidentifiedImageError, OSError, ValueError, Image.DecompressionBombError):
            left_out.append(f"Picture not readable: {picture.caption}")
            continue
        text = base64.b64encode(content).decode("ascii")
        uri = f"data:image/{kind.lower()};base64,{text}"
        if spent + len(uri) > BUDGET_BYTES * 4 / 3:
            left_out.append(f"{_TOO_MUCH}: {picture.caption}")
        else:
            spent += len(uri)
            size = {"width": width, "height": height}  # for a steady layout
            shown.append({"caption": picture.caption, "uri": uri} | size)
    return shown, left_out


# --------------------------------------------------------------------------------------------
# The page of a SLAM run: sentences on accuracy and consistency, tables, figures

_ABOUT_EQUAL = 1.05
_ROUND_FROM = 1000.0
_JUDGED = {
    "consistent": "errors as large as the covariances say",
    "overconfident": "errors larger than the covariances say",
    "conservative": "errors smaller than the covariances say",
}


def write_report(path: Path, data: ReportData) -> None:
    """Writes a run's page atomically; the same data give the same bytes. Raises OutputError."""
    write_html(path, slam_page(data))


def slam_page(data: ReportData) -> Page:
    """Sentences, tables and figures of a run."""
    rig = data.calibration
    return replace(
        data,
        headline=headline(data),
        figures=(
            drawn.drive_from_above(data),
            drawn.map_to_turn(data),
            drawn.error_over_time(data),
            drawn.error_by_axis(data),
            drawn.nees_over_time(data),
            drawn.time_per_frame(data),
            *([] if data.stages is None else [drawn.cost_by_stage(data.stages, data.start)]),
            *(drawn.matches_over_time(e) for e in data.estimators[:1] if e.counts),
            *([drawn.noise_over_time(data)] if any(e.noise for e in data.estimators) else []),
            *([drawn.calibration_over_time(rig, data.start)] if rig is not None else []),
        ),
        failed=frozenset((*data.alarms, *(e.title for e in data.estimators if e.failure))),
        remarks=data.remarks_of_all,
        drive=drawn.drive_along(data),
    )


def headline(data: ReportData) -> tuple[str, ...]:
    """Sentences about success, accuracy, consistency, cost and failures, most important first."""
    working = [e for e in data.estimators if not e.failure]
    lines = [*data.alarms]
    lines += [_accuracy(data, working)] if working else ["No estimator gave a result."]
    lines += [*_consistency(working), *_cost(working)]
    # By how much, differs from one to the next: each has its own among the remarks.
    whys = [e.truth_remark for e in working if e.truth_remark]
    lines += [f"{why[:1].upper()}{why[1:]}." for why in whys[:1]]
    lines += [f"{e.title} failed: {e.failure}" for e in data.estimators if e.failure]
    return tuple(lines)


def _accuracy(data: ReportData, working: list[EstimatorReport]) -> str:
    ranked = sorted((e.ate_m, e.title) for e in working if e.ate_m is not None)
    counts = sorted({e.matched_poses for e in working if e.ate_m is not None})
    if not ranked:
        why = "there is no ground truth" if data.truth is None else "too few poses have a truth"
        return f"How accurate the path is, is not known: {why}."
    poses = " or ".join(f"{count:,}" for count in counts)
    how = f"root mean square position error of {poses} poses, SE3 aligned"
    first, title = ranked[0]
    if len(ranked) == 1:
        return f"{title} is off by {metres(first)} ({how})."
    second, other = ranked[1]
    if second <= _ABOUT_EQUAL * first:
        equal = [name for error, name in ranked if error <= _ABOUT_EQUAL * first]
        rest = "".join(f"; {name} {metres(error)}" for error, name in ranked[len(equal) :])
        return f"{_listed(equal)} are about equally accurate: {metres(first)} ({how}){rest}."
    ratio = f", {second / first:.2g} times as much" if first > 0.0 else ""
    return (
        f"{title} is the most accurate: off by {metres(first)} ({how}). "
        f"The next, {other}, is off by {metres(second)}{ratio}."
    )


def _consistency(working: list[EstimatorReport]) -> Iterator[str]:
    for word, meaning in _JUDGED.items():
        found = [e for e in working if e.verdict == word]
        if found:
            names = [
                f"{e.title} ({_nees(e.nees_per_dof)} of {e.judged_poses:,} poses)" for e in found
            ]
            yield f"{word.capitalize()} ({meaning}): {_listed(names)}."
    unknown = [e.title for e in working if e.verdict not in _JUDGED]
    if unknown:
        yield f"Whether the covariances of {_listed(unknown)} can be believed is not known."


def _cost(working: list[EstimatorReport]) -> Iterator[str]:
    timed = [e for e in working if np.isfinite(e.update_ms).any()]
    medians = sorted((float(np.nanmedian(e.update_ms)), e.title) for e in timed)
    if len(medians) > 1:
        times = _listed([f"{title} {median:.2g} ms" for median, title in medians])
        yield f"The estimator's work for a frame took, in the median: {times}."


def _nees(value: float | None) -> str:
    if value is None:
        return "NEES not known"
    return f"NEES {value:,.0f}" if value >= _ROUND_FROM else f"NEES {value:.3g}"


def _listed(names: list[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
