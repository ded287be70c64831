"""Makes the pictures of the tutorials from a folder in which their commands were run.

    python -m scripts.make_tutorial_pictures FOLDER

``tests/integration/test_tutorials.py`` runs the commands, each tutorial in its own subfolder of
FOLDER, and then this; with ``--basetemp`` its folder stays to be looked at.
"""

from __future__ import annotations

import sys
from pathlib import Path

from PIL import Image

IMAGES = Path(__file__).parents[1] / "docs" / "images"
LARGEST = 100_000
"""Bytes of one picture."""
_WIDTH = 900

SOURCES = {
    "tutorial_webcams_board.jpg": "two_webcams/rig.png",
    "tutorial_webcams_map.jpg": "two_webcams/runs/room/pictures/map_from_above.png",
    "tutorial_bag_flow.jpg": "bag_to_map/runs/bag/pictures/flow_*.png",
    "tutorial_bag_map.jpg": "bag_to_map/runs/bag/pictures/map_views.png",
    "tutorial_route_taught.jpg": "teach_a_route/taught/pictures/path_images.png",
}
"""What each picture is made from; of several the last."""


def make(folder: Path, target: Path) -> None:
    """Writes every picture into ``target``, at most 900 pixels wide and 100 kB large."""
    for name, source in SOURCES.items():
        found = sorted(folder.glob(source))
        if not found:
            raise SystemExit(f"{folder / source}: no such picture; run that tutorial's commands")
        write_small(found[-1], target / name)


def write_small(source: Path, target: Path) -> None:
    """A picture as JPEG, on white, as good as its bytes allow."""
    with Image.open(source) as given:
        whole = given.convert("RGBA")
    picture = Image.new("RGB", whole.size, "white")
    picture.paste(whole, mask=whole.getchannel("A"))
    picture.thumbnail((_WIDTH, _WIDTH))
    for quality in range(90, 20, -10):
        picture.save(target, quality=quality, optimize=True)
        if target.stat().st_size < LARGEST:
            return


if __name__ == "__main__":
    make(Path(sys.argv[1]), IMAGES)
