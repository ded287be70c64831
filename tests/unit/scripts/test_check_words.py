"""The checker of words finds ours, with the field's in its place, and no part of another word."""

from __future__ import annotations

from pathlib import Path

from scripts.check_words import findings


def test_a_word_is_found_with_its_line_and_what_to_write(tmp_path: Path) -> None:
    (tmp_path / "room").mkdir()
    (tmp_path / "room" / "a.py").write_text('x = 1\n"""What the log says anew."""\n')
    found = findings(tmp_path, ("room",))
    assert found[0].startswith("room/a.py:2: says: write reported")
    assert found[1].startswith("room/a.py:2: anew: write again")


def test_parts_of_words_and_other_files_are_none(tmp_path: Path) -> None:
    (tmp_path / "a.py").write_text("outlook = booklet = renewed = 1\n")
    (tmp_path / "a.npz").write_text("beside")
    assert findings(tmp_path, (".",)) == []


def test_the_rooms_that_were_read_hold_none() -> None:
    assert findings(Path(__file__).parents[3]) == []
