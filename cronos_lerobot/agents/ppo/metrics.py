"""Metrics over the minibatches of an update."""

from __future__ import annotations

from cronos_lerobot.processes import Processes


class UpdateMetrics:
    """Means, weighted by the minibatches' sizes, and maxima."""

    def __init__(self) -> None:
        self._sums: dict[str, float] = {}
        self._weights: dict[str, float] = {}
        self._maxima: dict[str, float] = {}

    def add_means(self, values: dict[str, float], weight: float = 1.0) -> None:
        """Let `values` count `weight` times."""
        for name, value in values.items():
            self._sums[name] = self._sums.get(name, 0.0) + value * weight
            self._weights[name] = self._weights.get(name, 0.0) + weight

    def add_maxima(self, values: dict[str, float]) -> None:
        """Keep the largest of each of `values`."""
        for name, value in values.items():
            self._maxima[name] = max(value, self._maxima.get(name, value))

    def result(self, processes: Processes) -> dict[str, float]:
        """Return the mean over the processes of their means, and the maxima of all."""
        together = UpdateMetrics()
        for means, maxima in processes.gather((self._means(), self._maxima)):
            together.add_means(means)
            together.add_maxima(maxima)
        return together._means() | together._maxima

    def _means(self) -> dict[str, float]:
        return {name: total / self._weights[name] for name, total in self._sums.items()}
