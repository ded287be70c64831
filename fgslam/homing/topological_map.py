"""Topological map: images as nodes, homings that succeed as edges (I)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self, TypeAlias

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import connected_components, dijkstra

from fgslam.cameras.omni import OmniCamera
from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.bearings import OmniFeatures, Refusal, RefusalReason
from fgslam.core.errors import CalibrationError, StoredMapError
from fgslam.core.store import FileKind, require_covariances, require_finite
from fgslam.frontend.features.omni import OmniFeatureExtractor
from fgslam.frontend.features.sift import colour_image
from fgslam.frontend.homing.vector import pair_generator, vector_between
from fgslam.frontend.settings import HomingVectorSettings
from fgslam.homing.front_end import unusable
from fgslam.homing.links import (
    UNORDERED,
    Answer,
    InlierRows,
    Link,
    LinkConsistency,
    Pair,
    ThirdViewConsistency,
    VisualWords,
    Walks,
    candidate_pairs,
    link_pairs,
    sift_inliers,
)
from fgslam.homing.route import PACKED, PathMemory, StoredPath
from fgslam.homing.settings import DRIVING, TopologicalMapSettings

_DOUBLING_SUPPORT = 25.0  # inliers at which an edge costs twice what many inliers cost
_SIGMA_OF_ONE = np.deg2rad(5.0)  # direction's deviation that costs as much as a leg by itself


@dataclass(frozen=True, slots=True, eq=False)
class TopologicalMap:
    """Nodes and edges.

    Attributes:
        images: features of the nodes.
        names: of the nodes, for people.
        links: accepted, ascending by their pair (a < b).
        costs: (m,) of the links: 1 for a leg of many inliers and a sure direction, more otherwise.
        rejected: pairs that were answered, but not accepted, and why; not saved.
        camera: that took the images; None where it is not known.
    """

    images: tuple[OmniFeatures, ...]
    names: tuple[str, ...]
    links: tuple[Link, ...]
    costs: FloatArray
    rejected: Mapping[Pair, str]
    camera: OmniCamera | None = None

    def __len__(self) -> int:
        return len(self.images)

    def graph(self) -> csr_matrix:
        """(n, n) symmetric matrix of costs."""
        ends = np.array([(link.a, link.b) for link in self.links], dtype=np.int64).reshape(-1, 2)
        both = np.vstack([ends, ends[:, ::-1]])
        weights = np.concatenate([self.costs, self.costs])
        return coo_matrix((weights, (both[:, 0], both[:, 1])), (len(self), len(self))).tocsr()

    def components(self) -> tuple[IntArray, ...]:
        """Node numbers of the connected parts, the largest first."""
        _, label = connected_components(self.graph(), directed=False)
        parts = [np.flatnonzero(label == k) for k in range(int(label.max(initial=-1)) + 1)]
        return tuple(sorted(parts, key=lambda part: (-len(part), int(part[0]))))

    def neighbours(self, node: int) -> IntArray:
        """Nodes that are linked with one, ascending."""
        ends = [link.b if link.a == node else link.a for link in self.links]
        mine = [node in (link.a, link.b) for link in self.links]
        return np.sort(np.array(ends, dtype=np.int64)[np.array(mine, dtype=np.bool_)])

    def route(self, start: int, goal: int) -> tuple[int, ...]:
        """The cheapest way's nodes, both ends included.

        Raises:
            StoredMapError: there is no such node, or no way.
        """
        for node in (start, goal):
            if not 0 <= node < len(self):
                raise StoredMapError(
                    f"map: no node {node}; its {len(self)} nodes are numbered from 0"
                )
        cost, before = dijkstra(self.graph(), False, start, return_predecessors=True)
        if not np.isfinite(cost[goal]):
            raise StoredMapError(
                f"map: no way from {self.names[start]} to {self.names[goal]}; they lie in "
                "different parts of the map, take more images in between"
            )
        way = [goal]
        while way[-1] != start:
            way.append(int(before[way[-1]]))
        return tuple(reversed(way))

    def path(self, nodes: Sequence[int]) -> PathMemory:
        """The target images of a route, ready to be followed."""
        images, names = [self.images[k] for k in nodes], [self.names[k] for k in nodes]
        return PathMemory.of(images, names, self.camera)

    @property
    def memory(self) -> PathMemory:
        """The nodes' images alone."""
        return PathMemory(self.images, self.names, self.camera)

    def save(self, path: str | Path) -> float:
        """Writes the map atomically.

        Returns:
            Kilobytes (of 1000 bytes) an image.

        Raises:
            OutputError: it cannot be written.
        """
        stored = _StoredMap(StoredPath.of(self.memory), self.links, self.costs)
        return FILE.save(path, stored) / 1000.0 / max(len(self), 1)

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Reads a map; pixel positions of features are NaN, and nothing is known as rejected.

        Raises:
            StoredMapError: the file is missing, truncated, damaged, foreign or of another version.
        """
        stored = FILE.load(path)
        memory = stored.places.memory()
        return cls(memory.images, memory.names, stored.links, stored.costs, {}, memory.camera)


@dataclass(frozen=True, slots=True, eq=False)
class _StoredMap:
    """A topological map as files keep it."""

    places: StoredPath
    links: tuple[Link, ...]
    costs: FloatArray

    def require_sound(self) -> None:
        """Raises ValueError for names that are not unique, and links that no map has."""
        self.places.require_sound()
        n = len(self.places.images)
        if len(set(self.places.names)) < n:
            raise ValueError("two places have one name")
        if not all(0 <= link.a < link.b < n for link in self.links):
            raise ValueError("a link leads to no place")
        if len({(link.a, link.b) for link in self.links}) < len(self.links):
            raise ValueError("two links join the same places")
        if self.costs.shape != (len(self.links),) or not (self.costs > 0.0).all():
            raise ValueError("not one cost a link")
        require_finite("costs", self.costs)
        for link in self.links:
            # Without angles: a step that was driven; with the rotation alone: images of one place.
            turned = bool(np.isnan([link.direction, link.back]).all())
            angles = [] if turned else [link.direction, link.back]
            angles += [link.rotation] if link.support or not turned else []
            require_finite("angles of a link", np.array(angles))
            if link.support < 0:
                raise ValueError("a link has fewer inliers than none")
            if not turned:
                both = np.array([link.covariance, link.back_covariance])
                require_covariances("covariances of a link", both)


FILE = FileKind(
    _StoredMap,
    "fgslam topological map",
    version=4,
    error=StoredMapError,
    give="give a file that holds one, as fgslam join writes it",
    again="build it again",
    check=_StoredMap.require_sound,
    packed=PACKED,
)


# --------------------------------------------------------------------------------------------
# Building


def map_candidates(
    images: Sequence[OmniFeatures],
    settings: TopologicalMapSettings,
    rng: np.random.Generator,
    walks: Walks = UNORDERED,
) -> list[Pair]:
    """Pairs a < b that are worth a homing; neighbours on a walk always."""
    n = len(images)
    if settings.candidates == 0 or settings.candidates >= n - 1:
        likenesses = np.zeros((n, n))
    else:
        likenesses = VisualWords(images, rng).likenesses()
    pairs = {(int(a), int(b)) for a, b in candidate_pairs(likenesses, settings.candidates)}
    return sorted(pairs | walks.steps())


def map_of_answers(
    images: Sequence[OmniFeatures],
    answers: Mapping[Pair, Answer],
    *,
    walks: Walks = UNORDERED,
    names: Sequence[str] | None = None,
    rows: InlierRows | None = None,
) -> TopologicalMap:
    """The map of homings that were searched elsewhere, in processes say.

    Args:
        images: features of the nodes.
        answers: of pairs (from, to), both ways; pairs with one way only are passed over.
        walks: images that follow each other on a way.
        names: of the images; numbered if absent.
        rows: inliers of the answers; with them, links of walks far apart need third views.
    """
    memory = PathMemory.of(images, names)
    links, refused = link_pairs(answers)
    seen: set[Pair] = set()
    if walks.lengths and rows is not None:
        links, seen, unseen = ThirdViewConsistency(images, links, rows, walks).confirmed()
        refused |= unseen
    accepted, rejected = LinkConsistency(len(images), links, walks).accepted(seen)
    costs = np.array([link_cost(link) for link in accepted])
    return TopologicalMap(memory.images, memory.names, tuple(accepted), costs, refused | rejected)


def link_cost(link: Link) -> float:
    """One for a leg, more where few inliers or an unsure direction make it risky.

    So a route prefers a few safe legs to many, and two safe ones to one that is not.
    """
    variance = np.nan_to_num(max(link.covariance[0, 0], link.back_covariance[0, 0]))
    weak = _DOUBLING_SUPPORT / max(link.support, 1)
    return float(1.0 + weak + variance / _SIGMA_OF_ONE**2)


# --------------------------------------------------------------------------------------------
# Routes taught on several days, joined where their views match: one map, with crossroads
#
# All path images are nodes of one topological map. Images that follow each other on a route are
# linked, as the way between them was driven; images of different routes, and of one that comes by
# again, where homing vectors agree there and back and third views confirm them. An image from
# anywhere finds its place as one more node would. After Goedemé et al. (2005), section I.


FEATURES = DRIVING.features
VECTOR = HomingVectorSettings(samples=1000, confidence=0.999999, second_look=False)
"""As of images that are only compared: stricter than for driving. There is no second look, as most
pairs share nothing, and those that do not follow each other must convince by more than one."""

_ALL = 60  # images of a map that are tried against all others
_CANDIDATES = 40
"""Otherwise so many, the most alike: of the 60 school corridors' views, from day to night, that is
what keeps all connected (docs/results/routes.md)."""

_NO_WAY = 0.01  # cost between two images of one place; a leg has more than 1
_STREAM = 10  # of the seed's random numbers
_UNDECIDED = (RefusalReason.AMBIGUOUS, RefusalReason.UNCERTAIN, RefusalReason.AT_TARGET)

Answered: TypeAlias = tuple[Answer, IntArray | None]
"""The homing vector of a pair, and (k, 2) SIFT features of both images that are its inliers."""

Asker: TypeAlias = Callable[[tuple[OmniFeatures, ...], Sequence[Pair]], Mapping[Pair, Answered]]
"""Homing vectors between images, by their numbers, with :data:`FEATURES` and :data:`VECTOR`."""


@dataclass(frozen=True, slots=True, eq=False)
class MapPlace:
    """Where an image was taken.

    Attributes:
        name: of the place that it was taken at, else of the one that it has most in common with.
        at: it was taken at that place.
        inliers: features in common with it.
        links: to all places that it was recognised from; ``b`` is the image, ``back`` the direction
            of the place as seen from it.
    """

    name: str
    at: bool
    inliers: int
    links: tuple[Link, ...]


@dataclass(frozen=True, slots=True, eq=False)
class RouteMap(TopologicalMap):
    """Several routes as one map; its nodes are called ``route/image``."""

    @staticmethod
    def join(
        routes: Mapping[str, PathMemory], *, seed: int = 0, ask: Asker | None = None
    ) -> RouteMap:
        """Joins routes where their views match.

        Args:
            routes: by name, each with its path images in the order in which they were driven.
            seed: of everything random.
            ask: finds homing vectors, in processes say; None: one after the other.

        Raises:
            StoredMapError: no route, an empty one, or one with two images of one name.
        """
        ask = ask or asked_in_turn(seed)
        memory, walks = _memory_of(routes)
        count = len(memory)
        settings = TopologicalMapSettings(candidates=0 if count <= _ALL else _CANDIDATES)
        there = map_candidates(
            memory.images, settings, np.random.default_rng((seed, _STREAM)), walks
        )
        answers, rows = _both_ways(ask, memory.images, there)
        joined = map_of_answers(memory.images, answers, walks=walks, names=memory.names, rows=rows)
        return _with_driven_steps(joined, walks, memory.camera)

    def knows(self, name: str) -> bool:
        """Whether a place or a route is called so."""
        return name in self.names or name in map(route_of, self.names)

    def link(self, start: str, end: str) -> Link:
        """From one place to another, by their names. Raises StoredMapError where they have none."""
        a, b = self._node(start), self._node(end)
        for link in self.links:
            if (link.a, link.b) == (min(a, b), max(a, b)):
                return link if a < b else link.reversed()
        raise StoredMapError(f"map: {start} and {end} are not linked")

    @property
    def crossroads(self) -> tuple[str, ...]:
        """Names of places that are linked with more than two others."""
        degree = np.zeros(len(self), np.int64)
        for link in self.links:
            degree[[link.a, link.b]] += 1
        return tuple(name for name, links in zip(self.names, degree, strict=True) if links > 2)

    def locate(
        self, image: npt.ArrayLike, camera: OmniCamera | None = None, *, seed: int = 0
    ) -> MapPlace | Refusal:
        """Where an image was taken; false where no place is recognised in it.

        Args:
            image: (height, width, 3) RGB or (height, width) grey uint8.
            camera: that took it; None: the routes' own.
            seed: of RANSAC's samples.

        Raises:
            CalibrationError: the routes were taught with several cameras, and none is given.
            FrameError: the image is not the camera's.
        """
        camera = camera or self.camera
        if camera is None:
            raise CalibrationError(
                "map: its routes were taught with several cameras; give the image's: "
                "camera=fgslam.load_camera(FILE)"
            )
        picture = colour_image(image, (camera.width, camera.height))
        features = OmniFeatureExtractor(camera, FEATURES).extract(picture)
        refusal = unusable(picture, features)
        return self._placed(features, asked_in_turn(seed)) if refusal is None else refusal

    def way(self, start: str | MapPlace, goal: str) -> PathMemory:
        """The path images of the shortest way, ready to be followed.

        Args:
            start: name of a place, or what :meth:`locate` found.
            goal: name of a place; that of a route is its last image.

        Raises:
            StoredMapError: there is no such place, or no way.
        """
        end = self._node(goal)
        if isinstance(start, MapPlace):
            nodes = self._with_image(start.links).route(len(self), end)[1:]
        else:
            nodes = self.route(self._node(start), end)
        return self.path(nodes)

    # ----------------------------------------------------------------------------------------

    def _node(self, name: str) -> int:
        ends = {route_of(one): k for k, one in enumerate(self.names)}
        found = {one: k for k, one in enumerate(self.names)}.get(name, ends.get(name))
        if found is None:
            raise StoredMapError(
                f"map: no place {name}; its routes are {', '.join(ends)}, their places "
                f"{self.names[0]} to {self.names[-1]}"
            )
        return found

    def _placed(self, features: OmniFeatures, ask: Asker) -> MapPlace | Refusal:
        """The place of an image as the node that it would be."""
        here, known = len(self), [link for link in self.links if link.support]
        pairs = [(node, here) for node in self._alike(features)]
        answers, _ = _both_ways(ask, (*self.images, features), pairs)
        links, _ = link_pairs(answers)
        checks = LinkConsistency(here + 1, [*known, *links])
        accepted, _ = checks.accepted({(link.a, link.b) for link in known})
        mine = tuple(link for link in accepted if link.b == here)
        if not mine:
            best = max((link.support for link in links), default=0)
            text = f"no place of the map is recognised in it (best: {best} features in common)"
            return Refusal(RefusalReason.TOO_FEW_INLIERS, text)
        nearest = max(mine, key=lambda link: (_at_one_place(link), link.support))
        return MapPlace(self.names[nearest.a], _at_one_place(nearest), nearest.support, mine)

    def _alike(self, features: OmniFeatures) -> list[int]:
        """Nodes that an image is tried against."""
        if len(self) <= _ALL:
            return list(range(len(self)))
        words = VisualWords(self.images, np.random.default_rng(_STREAM))
        order = np.argsort(-words.likeness(features), kind="stable")
        return sorted(order[:_CANDIDATES].tolist())

    def _with_image(self, links: Iterable[Link]) -> TopologicalMap:
        """The map with one more node, whose features are not needed."""
        mine, usual = tuple(links), _usual_support(self.links)
        costs = [*self.costs.tolist(), *(_undriven_cost(link, usual) for link in mine)]
        images, names = (*self.images, self.images[0]), (*self.names, "the image")
        return TopologicalMap(images, names, (*self.links, *mine), np.array(costs), {})


def route_of(name: str) -> str:
    """The route's name in a place's."""
    return name.split("/", 1)[0]


def asked_in_turn(seed: int) -> Asker:
    """Homing vectors one after the other, in this process."""

    def ask(images: tuple[OmniFeatures, ...], pairs: Sequence[Pair]) -> Mapping[Pair, Answered]:
        return {(a, b): _answered(images[a], images[b], (seed, a, b)) for a, b in pairs}

    return ask


def _answered(first: OmniFeatures, second: OmniFeatures, draw: tuple[int, int, int]) -> Answered:
    rng = pair_generator(*draw)
    answer, matches = vector_between(first, second, FEATURES.matching, VECTOR, rng)
    return answer, sift_inliers(answer, matches)


def _both_ways(
    ask: Asker, images: tuple[OmniFeatures, ...], there: Sequence[Pair]
) -> tuple[dict[Pair, Answer], dict[Pair, IntArray]]:
    """Answers there and, where they leave a chance of a link, back; and their inliers."""
    found = dict(ask(images, there))
    hopeful = [
        (b, a)
        for (a, b), (answer, _) in found.items()
        if not isinstance(answer, Refusal) or answer.reason in _UNDECIDED
    ]
    found |= ask(images, hopeful)
    rows = {pair: inliers for pair, (_, inliers) in found.items() if inliers is not None}
    return {pair: answer for pair, (answer, _) in found.items()}, rows


def _memory_of(routes: Mapping[str, PathMemory]) -> tuple[PathMemory, Walks]:
    """All path images, one route after the other."""
    if not routes or not all(map(len, routes.values())):
        raise StoredMapError("map: no route, or one without path images; teach them first")
    if any("/" in route for route in routes):
        raise StoredMapError("map: a route's name holds a slash; call it otherwise")
    names = [f"{route}/{name}" for route, path in routes.items() for name in path.names]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise StoredMapError(f"map: two path images are called {twice[0]}; give each its own name")
    images = tuple(image for path in routes.values() for image in path.images)
    first, *others = [path.camera for path in routes.values()]
    camera = first if all(other == first for other in others) else None
    walks = Walks(tuple(len(path) for path in routes.values()))
    return PathMemory(images, tuple(names), camera), walks


def _with_driven_steps(joined: TopologicalMap, walks: Walks, camera: OmniCamera | None) -> RouteMap:
    """With links along the routes also where there is no homing vector: the way was driven.

    They cost as much as a dozen legs, so that they are gone where there is nothing else.
    """
    steps = walks.steps()
    missing = steps - {(link.a, link.b) for link in joined.links}
    nowhere, unknown = np.full((2, 2), np.nan), float("nan")
    driven = [
        Link(a, b, unknown, unknown, unknown, nowhere, nowhere, 0) for a, b in sorted(missing)
    ]
    links = tuple(sorted([*joined.links, *driven], key=_ends))
    usual = _usual_support(link for link in links if _ends(link) in steps)
    costs = [
        link_cost(link) if _ends(link) in steps else _undriven_cost(link, usual) for link in links
    ]
    return RouteMap(joined.images, joined.names, links, np.array(costs), joined.rejected, camera)


def _undriven_cost(link: Link, usual: float) -> float:
    """Of a way that was not driven: the fewer of the usual inliers, the longer it probably is."""
    if _at_one_place(link):
        return _NO_WAY
    return link_cost(link) * max(1.0, usual / max(link.support, 1))


def _at_one_place(link: Link) -> bool:
    """Whether both images were taken there: a turn, without a direction."""
    return link.support > 0 and not np.isfinite(link.direction)


def _usual_support(links: Iterable[Link]) -> float:
    """Median inliers of links that have a homing vector."""
    found = [link.support for link in links if link.support]
    return float(np.median(found)) if found else 1.0


def _ends(link: Link) -> Pair:
    return link.a, link.b
