"""What the engines that run exported graphs share."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from pathlib import Path
from typing import ClassVar

from psiamfcpp.errors import UserError
from psiamfcpp.geometry import Image
from psiamfcpp.machine import usable_cores
from psiamfcpp.runtime.device import CPU, Device
from psiamfcpp.runtime.engine import Float32Array, Images, resized, warm_up
from psiamfcpp.runtime.graph_file import check_onnx, damaged, graph_precision, same_model
from psiamfcpp.runtime.lanes import Lanes, Search
from psiamfcpp.spec import ModelSpec

Kernels = tuple[Float32Array, ...]
Template = Callable[[Image], Kernels]


class GraphEngine(ABC):
    """An engine on the two graphs of a model; a subclass opens a graph, and this class does the rest.

    See `psiamfcpp.runtime.engine.Engine` for the calls.

    Args:
        graphs: files of the template and the search graph.
        threads: threads that may be used; by default one for each usable core.
        search_size: side of the search crop in pixels; by default the model's own.
        device: where to compute; it must be one that the subclass knows.

    Raises:
        UserError: a graph cannot be loaded, or the two are not of one model.
    """

    name: ClassVar[str]

    def __init__(
        self,
        graphs: tuple[Path, Path],
        threads: int | None = None,
        search_size: int | None = None,
        device: Device = CPU,
    ):
        template, search = graphs
        for path in graphs:
            if path.suffix == ".onnx":
                check_onnx(path)
        try:
            self._start(template, search, threads or usable_cores(), search_size, device)
        except UserError:
            raise
        except Exception as error:  # the runtimes' errors have no common base of their own
            if device.kind != "cpu":
                raise
            raise damaged(template.parent, error) from None

    def _start(self, template: Path, search: Path, total: int, search_size: int | None, device: Device) -> None:
        self.device = str(device)
        self._template, described = self._open_template(template, total, device)
        self.spec = resized(described, search_size)
        side = self.spec.search_size
        (self._search,), other = self._open_search(search, side, total, 1, device)
        same_model(template, described, search, other)
        self.precision = graph_precision(search)
        # Searches side by side share the cores of the processor; a GPU is given one after the other.
        shared = total if device.kind == "cpu" else 1
        self._lanes = Lanes(
            shared, self.search, lambda count: self._open_search(search, side, total // count, count, device)[0]
        )
        warm_up(self)

    def template(self, crop: Image) -> Kernels:
        """Return what `search` needs of a template crop ``(Z, Z, 3)``, uint8, BGR."""
        return self._template(crop)

    def search(self, crop: Image, kernels: Kernels) -> tuple[Float32Array, Float32Array]:
        """Return scores ``(N, N)`` and boxes ``(N, N, 4)`` of a search crop ``(S, S, 3)``, uint8, BGR."""
        return self._search(crop, kernels)

    def search_many(self, crops: Images, kernels: list[Kernels]) -> tuple[Float32Array, Float32Array]:
        """Return scores ``(B, N, N)`` and boxes ``(B, N, N, 4)`` of crops ``(B, S, S, 3)``, uint8, BGR."""
        return self._lanes.search_many(crops, kernels)

    @abstractmethod
    def _open_template(self, path: Path, threads: int, device: Device) -> tuple[Template, ModelSpec]:
        """Open the template graph.

        Returns:
            The function that computes kernels, and what the graph's metadata says of the model.
        """

    @abstractmethod
    def _open_search(
        self, path: Path, search_size: int, threads: int, lanes: int, device: Device
    ) -> tuple[list[Search], ModelSpec]:
        """Open the search graph.

        Args:
            path: the graph.
            search_size: side of the search crop in pixels.
            threads: threads of each lane.
            lanes: number of searches that may run at once.
            device: where to compute.

        Returns:
            One search function per lane, and what the graph's metadata says of the model.
        """
