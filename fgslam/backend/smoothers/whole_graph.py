"""Smoothers that keep every pose: they close loops in the graph, and see what it costs."""

from __future__ import annotations

import dataclasses
from abc import abstractmethod
from typing import Any

import numpy as np

from fgslam.backend.filters.submaps import Constraint, constraint_factor
from fgslam.backend.smoothers.graph_solution import poses_of_frame
from fgslam.backend.smoothers.loop_closing import first_guess, misfit, solved
from fgslam.backend.smoothers.settings import GraphSettings
from fgslam.backend.smoothers.smoother import Smoother
from fgslam.core.arrays import IntArray, StateArrays
from fgslam.core.estimates import LandmarkMap, Prediction
from fgslam.core.floor import Floor
from fgslam.core.measurements import LoopClosure
from fgslam.core.quantiles import chi_square_quantile
from fgslam.core.sensors import Sensor

_AGREES = float(chi_square_quantile(0.99, 6))  # 16.8: a loop that the graph meets as it is


class WholeGraphSmoother(Smoother):
    """What iSAM2 and the batch share about loops and saved maps."""

    def __init__(
        self, sensor: Sensor, settings: GraphSettings, floor: Floor, prior: Prediction
    ) -> None:
        """Starts at the prior pose with an empty map."""
        super().__init__(sensor, settings, floor, prior)
        self._prior = prior
        self._begun_in: StateArrays = {}

    @property
    def keeps_maps(self) -> bool:
        """A smoother's landmarks are what it estimates."""
        return False

    def begin_in(self, landmarks: LandmarkMap, hits: IntArray, fixed: bool) -> None:
        """Takes a saved map over: a prior factor for each landmark that is seen again."""
        self._tracker.begin_in(landmarks, hits, fixed=False)
        self._builder.know(landmarks)
        self._begun_in = {
            "map/ids": landmarks.ids,
            "map/positions": landmarks.positions,
            "map/covariances": landmarks.covariances,
            "map/hits": hits,
            "map/prior_pose": self._prior.wTc,
            "map/prior_covariance": self._prior.covariance,
        }

    def state(self) -> StateArrays:
        """The map that it began in, and where, and everything that was put in."""
        return super().state() | self._begun_in

    def restore(self, state: StateArrays) -> None:
        """Repeats everything since the beginning."""
        if "map/ids" in state:
            self._start_at(Prediction(state["map/prior_pose"], state["map/prior_covariance"]))
            known = (state[f"map/{name}"] for name in ("ids", "positions", "covariances"))
            self.begin_in(LandmarkMap(*known), state["map/hits"], fixed=False)
        super().restore(state)

    def _start_at(self, prior: Prediction) -> None:
        """Another prior pose: who goes on with a run in a map does not know where that began."""
        self._prior = self._smoothed = prior
        self._builder.start_at(prior)
        self._tracker.correct(prior, np.empty(0, np.int64), np.empty((0, 3)))

    def _close(self, loop: LoopClosure, where: str) -> bool:
        """Closes a loop where the measurements allow it; whether they do.

        One that the graph meets anyway is a factor more. Otherwise the graph is solved with it, and
        it is refused where that raises the cost by more than measurement noise explains: a true
        loop's rise is chi-square with six degrees of freedom, whatever the drift.
        """
        known = self._between(loop)
        what = f"{where}: loop closure to frame {loop.frame} of the log"
        off = misfit(constraint_factor(known), self._values_now())
        if off <= _AGREES:
            self._accept(known, None)
            self._remarks.append(f"{what}: as expected, nothing moved")
            return True
        rise, found, shift = self._bent(known)
        gate = self._loop_settings.gate_sigmas
        if gate > 0.0 and not rise <= gate**2:
            self._remarks.append(
                f"{what} refused: {np.sqrt(max(rise, 0.0)):.1f} standard deviations off, "
                f"{gate:g} allowed"
            )
            return False
        self._accept(known, found)
        self._remarks.append(f"{what}: the camera moved by {shift:.2f} m, the graph with it")
        return True

    def _bent(self, known: Constraint) -> tuple[float, Any, float]:
        """Rise of the cost with a loop closed, the values then, and how far the camera moves."""
        graph = self._loop_graph()
        try:
            before = self._solved_before(graph)
            cost, loops = float(graph.error(before)), [*self._loops, known]
            every = self._loop_settings.submap_frames
            chain = self._tracker.chain
            guess = first_guess(self._builder, before, chain, loops, every)
            graph.add(constraint_factor(known))
            found = solved(graph, guess)
        except RuntimeError as error:
            raise self._failed(error) from None
        here = poses_of_frame(found, known.after)[:3, 3]
        shift = float(np.linalg.norm(here - self._tracker.predict(None).wTc[:3, 3]))
        return 2.0 * (float(graph.error(found)) - cost), found, shift

    def _accept(self, known: Constraint, found: Any | None) -> None:
        """Believed now, it is doubted when later ones contradict it."""
        known = dataclasses.replace(known, doubted=True)
        self._builder.add_factor(constraint_factor(known))
        self._loops.append(known)
        self._join(known, found)

    def _loop_graph(self) -> Any:
        """The graph as it is to be solved when a loop is judged."""
        return self._builder.kept_factors()

    @abstractmethod
    def _values_now(self) -> Any:
        """Values of all poses so far and all landmarks of the graph."""

    @abstractmethod
    def _solved_before(self, graph: Any) -> Any:
        """The same at the minimum of the graph so far."""

    @abstractmethod
    def _join(self, known: Constraint, found: Any | None) -> None:
        """Goes on with the graph that has the loop; from these values where they are given."""
