"""What a YAML text cannot mean is one line that says where, whatever PyYAML makes of it."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from fgslam.core.errors import ConfigError, FgslamError, one_line
from fgslam.core.yaml_text import plain_values, read_yaml

BOMB = "a0: &a0 [x, x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 10)}]\n" for k in range(1, 10)
)


def message_of(content: bytes, tmp_path: Path) -> str:
    path = tmp_path / "experiment.yaml"
    path.write_bytes(content)
    with pytest.raises(ConfigError) as caught:
        read_yaml(path, ConfigError)
    message = str(caught.value)
    assert "\n" not in message
    assert len(message.replace(str(path), "")) < 300
    assert str(path) in message
    return message


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a: 1\nb: !!int x\n", "line 2: not valid YAML ('x' is no int)"),
        ("a: 1\nb: !!bool x\n", "line 2: not valid YAML ('x' is no bool)"),
        ("a: 1\nb: !!python/object:os.system x\n", "line 2: not valid YAML (could not"),
        (f"a: 1\nb: {'9' * 6000}\n", "line 2: not valid YAML ('999999999999999999999999999999..."),
        (f"a: 1\nb: {'9' * 30}\n", "is too large a number"),
        (f"a: 1\nb: {'[' * 5000}\n", "line 2: not valid YAML (nested over 50 deep)"),
        (BOMB, "line 5: not valid YAML (more than 20000 values, aliases counted each time)"),
        (f"b: [{'1,' * 3_000_000}]\n", "6.0 MB, 1 MB at most"),
        ("a: &a [*a]\n", "line 1: not valid YAML (an alias of what it stands in)"),
        ("a: 1\nb: 2\na: 3\n", "line 3: not valid YAML (key 'a' is given twice; remove one)"),
        ("? [a]\n: 1\n", "line 1: not valid YAML (found unhashable key)"),
        (f"a: *{'u' * 5000}\n", "line 1: not valid YAML (found undefined alias"),
        ("a: 1\0\n", "not valid YAML (unacceptable character"),
    ],
)
def test_what_yaml_cannot_mean_is_said_with_its_line(text: str, words: str, tmp_path: Path) -> None:
    assert words in message_of(text.encode(), tmp_path)


@pytest.mark.parametrize("encoding", ["utf-16", "utf-32-le", "latin-1"])
def test_other_encodings_are_named(encoding: str, tmp_path: Path) -> None:
    words = "not text in UTF-8, but in UTF-16" if encoding == "utf-16" else "not "
    assert words in message_of("name: café\n".encode(encoding), tmp_path)


def test_a_byte_order_mark_is_no_part_of_the_first_key(tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    path.write_bytes(b"\xef\xbb\xbfname: x\n")
    assert read_yaml(path, ConfigError) == {"name": "x"}


def test_a_date_is_text_and_a_name_may_look_like_one() -> None:
    assert plain_values("name: 2026-11-22\n") == {"name": "2026-11-22"}
    assert plain_values("t: 2026-99-99 25:61:61\n") == {"t": "2026-99-99 25:61:61"}


def test_aliases_and_merged_keys_mean_what_they_do_in_yaml() -> None:
    text = "a: &a {x: 1, y: [2]}\nb: *a\nc: {<<: *a, x: 3}\n"
    assert plain_values(text) == yaml.safe_load(text)


def test_a_message_repeats_little_of_what_was_given_and_stays_one_line() -> None:
    message = str(FgslamError(f"key {'k' * 5000} is\n\x1b[31munknown"))
    assert "\n" not in message
    assert "\x1b" not in message
    assert len(message) < 260
    assert message.startswith("key kkk")
    assert message.endswith(r"is\n\x1b[31munknown")
    assert len(one_line("a b " * 5000)) <= 1500
