"""Strategies that choose the next point in a parameter space: at random, on a grid, or by an optimiser."""

from __future__ import annotations

import warnings
from abc import ABC, abstractmethod
from typing import Any, Final, Literal, get_args

import numpy as np

from shmio.config.ranges import Choice, Dimension, Point, Space
from shmio.errors import ConfigError
from shmio.libraries import library

SearchName = Literal["tpe", "cmaes", "random", "grid"]
SEARCHES: Final[tuple[SearchName, ...]] = get_args(SearchName)
MAX_TRIALS: Final = 1_000_000
"""Maximum number of trials of a search."""
MAX_OPTIMISED: Final = 10_000
"""Maximum number of trials with an optimiser, because its time for a point grows with the number of points."""
REMEDY: Final = "pip install 'shmio[falsify]', or use --search random or grid"


class Search(ABC):
    """Chooses points. With the same seed, and the same results in the same order, it chooses the same points."""

    def __init__(self, space: Space) -> None:
        self._space = space

    @abstractmethod
    def ask(self, number: int) -> Point | None:
        """Return the point for trial ``number``; None if there are no more points.

        Call this for the numbers 0, 1, 2 and so on.
        """

    def tell(self, number: int, robustness: float | None) -> None:  # noqa: B027  not every search learns
        """Learn the robustness of trial ``number``; None if it has no robustness.

        Call this for the numbers 0, 1, 2 and so on.
        """


def begin_search(name: SearchName, space: Space, seed: int, trials: int, jobs: int) -> Search:
    """Return a new search.

    Args:
        name: Name of the strategy.
        space: The parameter space.
        seed: Seed, which is the search's only source of randomness.
        trials: Number of trials.
        jobs: Number of trials that run at once.

    Raises:
        ConfigError: There are more trials than an optimiser can handle.
        MissingLibraryError: The library of an optimiser is not installed.

    """
    if name == "random":
        return RandomSearch(space, seed)
    if name == "grid":
        return GridSearch(space, seed, trials)
    return OptunaSearch(space, seed, trials, jobs, name)


class RandomSearch(Search):
    """Draws each point independently: it depends only on the seed and the number of the trial."""

    def __init__(self, space: Space, seed: int) -> None:
        super().__init__(space)
        self._seed = seed

    def ask(self, number: int) -> Point:
        """Return the point for trial ``number``."""
        draw = np.random.default_rng([self._seed, number])
        return {one.name: one.at(draw.random()) for one in self._space.dimensions}


class GridSearch(Search):
    """Tries the points of a grid in random order. All dimensions have about the same number of values."""

    def __init__(self, space: Space, seed: int, trials: int) -> None:
        super().__init__(space)
        self.counts = _levels(space.dimensions, trials)
        """The number of values of each dimension."""
        self._order = np.random.default_rng(seed).permutation(int(np.prod(self.counts)))

    def ask(self, number: int) -> Point | None:
        """Return the point for trial ``number``; None if the grid has no more points."""
        if number >= len(self._order):
            return None
        rest = int(self._order[number])
        point: dict[str, Any] = {}
        for one, count in zip(self._space.dimensions, self.counts, strict=True):
            rest, level = divmod(rest, count)
            point[one.name] = one.at(
                (level + 0.5) / count if one.count is not None or count == 1 else level / (count - 1)
            )
        return point


def _levels(dimensions: tuple[Dimension, ...], trials: int) -> list[int]:
    """Return how many values of each dimension a grid of at most ``trials`` points has."""
    counts = [1] * len(dimensions)
    while True:
        size = int(np.prod(counts))
        growing = [
            index
            for index, one in enumerate(dimensions)
            if (one.count is None or counts[index] < one.count)
            and size // counts[index] * (counts[index] + 1) <= trials
        ]
        if not growing:
            return counts
        counts[min(growing, key=counts.__getitem__)] += 1


class OptunaSearch(Search):
    """Lets a sampler of optuna choose the points: tree-structured Parzen estimators, or CMA-ES."""

    def __init__(self, space: Space, seed: int, trials: int, jobs: int, name: SearchName) -> None:
        super().__init__(space)
        if name == "cmaes":
            library("cmaes", REMEDY)  # optuna would import it only after some trials
        optuna = library("optuna", REMEDY)
        if trials > MAX_OPTIMISED:
            raise ConfigError(
                f"--trials {trials}: --search {name} takes at most {MAX_OPTIMISED}; "
                "for more, use --search random or grid"
            )
        optuna.logging.set_verbosity(optuna.logging.ERROR)
        self._failed = optuna.trial.TrialState.FAIL
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
            if name == "cmaes":
                sampler: Any = optuna.samplers.CmaEsSampler(seed=seed)
            else:
                sampler = optuna.samplers.TPESampler(seed=seed, multivariate=True, constant_liar=jobs > 1)
        self._study = optuna.create_study(sampler=sampler)
        self._distributions = {one.name: _distribution(one, optuna) for one in space.dimensions}
        self._trials: dict[int, Any] = {}

    def ask(self, number: int) -> Point:
        """Return the point for trial ``number``."""
        trial = self._trials[number] = self._study.ask(self._distributions)
        return {
            one.name: one.options[trial.params[one.name]]
            if isinstance(one, Choice)
            else one.nearest(trial.params[one.name])
            for one in self._space.dimensions
        }

    def tell(self, number: int, robustness: float | None) -> None:
        """Learn the robustness of trial ``number``; None if it has no robustness."""
        trial = self._trials.pop(number)
        if robustness is None:
            self._study.tell(trial, state=self._failed)
        else:
            self._study.tell(trial, robustness)


def _distribution(one: Dimension, optuna: Any) -> Any:
    if isinstance(one, Choice):
        return optuna.distributions.CategoricalDistribution(tuple(range(one.count)))
    if one.whole:
        low, high, step = int(one.low), int(one.high), int(one.step or 1)
        return optuna.distributions.IntDistribution(low, high - (high - low) % step, log=one.log, step=step)
    top = one.high if one.step is None else one.nearest(one.high)
    return optuna.distributions.FloatDistribution(one.low, top, log=one.log, step=one.step)
