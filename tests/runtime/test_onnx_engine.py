"""Sums in 8 bits, and a GPU with a session that stands in for one: what it is asked for, what a user reads without."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import pytest
from numpy.testing import assert_array_equal

from psiamfcpp import UserError
from psiamfcpp.runtime import onnx_engine, open_engine

CPU, CUDA, TENSORRT = ("CPUExecutionProvider", "CUDAExecutionProvider", "TensorrtExecutionProvider")
RealSession = onnxruntime.InferenceSession


class Gpu:
    """The GPU wheel, as far as this package sees it; it computes on the processor."""

    def __init__(self) -> None:
        self.listed = [TENSORRT, CUDA, CPU]
        """what the wheel has"""
        self.starts = [TENSORRT, CUDA, CPU]
        """what finds its libraries"""
        self.asked: list[list[Any]] = []
        self.printed = ""
        self.fails: Exception | None = None

    def session(self, graph: Any, options: Any, providers: list[Any], enable_fallback: int) -> Any:
        assert enable_fallback == 0
        self.asked.append(providers)
        if self.fails and providers[0] != CPU:
            raise self.fails
        session = RealSession(graph, options, providers=[CPU])
        names = [entry if isinstance(entry, str) else entry[0] for entry in providers]
        session.get_providers = lambda: [name for name in names if name in self.starts]  # type: ignore[method-assign]
        return session


@pytest.fixture
def gpu(monkeypatch: pytest.MonkeyPatch) -> Iterator[Gpu]:
    fake = Gpu()
    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: fake.listed)
    monkeypatch.setattr(onnxruntime, "InferenceSession", fake.session)
    monkeypatch.setattr(onnxruntime, "preload_dlls", lambda: print(fake.printed), raising=False)
    monkeypatch.setattr(onnx_engine, "products_saturate", lambda: False)
    onnx_engine._preloaded.cache_clear()
    yield fake
    onnx_engine._preloaded.cache_clear()


@pytest.fixture
def wheels(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Sets which wheels are installed."""

    def install(*names: str) -> None:
        def version(name: str) -> str:
            if name not in names:
                raise onnx_engine.PackageNotFoundError(name)
            return "1.0"

        monkeypatch.setattr(onnx_engine, "version", version)

    return install


@pytest.mark.parametrize(
    ("device", "expected"),
    [
        ("cuda", [(CUDA, {"device_id": 0, "use_tf32": 0}), (CPU, {})]),
        ("cuda:2", [(CUDA, {"device_id": 2, "use_tf32": 0}), (CPU, {})]),
        ("tensorrt:1", [(TENSORRT, {"device_id": 1}), (CUDA, {"device_id": 1, "use_tf32": 0}), (CPU, {})]),
    ],
)
def test_both_graphs_are_given_to_the_gpu(tiny_graphs: Path, gpu: Gpu, device: str, expected: list[Any]) -> None:
    opened = open_engine(str(tiny_graphs), "onnx", 2, device=device)
    assert gpu.asked == [expected, expected]
    assert (opened.name, opened.precision) == ("onnx", "fp32")
    assert opened.device == (device if ":" in device else f"{device}:0")
    rng = np.random.default_rng(0)
    crops = rng.integers(0, 256, (3, 303, 303, 3), np.uint8)
    kernels = [opened.template(np.ascontiguousarray(crop[:127, :127])) for crop in crops]
    scores, _ = opened.search_many(crops, kernels)
    assert_array_equal(scores[2], opened.search(crops[2], kernels[2])[0])
    # several crops are searched in the same session, one after the other: no lanes were opened
    assert len(gpu.asked) == 2


def test_the_processor_is_asked_for_alone_by_default(tiny_graphs: Path, gpu: Gpu) -> None:
    assert open_engine(str(tiny_graphs), threads=1).device == "cpu"
    assert gpu.asked == [[CPU], [CPU]]


def test_a_wheel_without_cuda_is_to_be_exchanged(tiny_graphs: Path, gpu: Gpu, wheels: Callable[..., None]) -> None:
    gpu.listed = [CPU]
    wheels("onnxruntime")
    with pytest.raises(
        UserError, match="device cuda:0: the installed onnxruntime has no CUDAExecutionProvider: pip un"
    ):
        open_engine(str(tiny_graphs), "onnx", device="cuda")
    assert gpu.asked == []


def test_two_wheels_at_once_are_named(tiny_graphs: Path, gpu: Gpu, wheels: Callable[..., None]) -> None:
    gpu.listed = [CPU]
    wheels("onnxruntime", "onnxruntime-gpu")
    with pytest.raises(UserError, match=r"both installed and overwrite each other: pip uninstall -y onnxruntime onnx"):
        open_engine(str(tiny_graphs), "onnx", device="cuda")
    # neither is in the way of the processor, nor of a GPU whose wheel was installed last
    assert open_engine(str(tiny_graphs), "onnx", 1).device == "cpu"
    gpu.listed = [CUDA, CPU]
    assert open_engine(str(tiny_graphs), "onnx", 1, device="cuda").device == "cuda:0"


def test_a_tensorrt_that_the_wheel_lacks_is_named(tiny_graphs: Path, gpu: Gpu) -> None:
    gpu.listed = [CUDA, CPU]
    with pytest.raises(UserError, match=r"device tensorrt:0: .* has no TensorrtExecutionProvider"):
        open_engine(str(tiny_graphs), "onnx", device="tensorrt")


def test_missing_libraries_do_not_end_on_the_processor(
    tiny_graphs: Path, gpu: Gpu, capsys: pytest.CaptureFixture[str]
) -> None:
    gpu.starts = [CPU]
    gpu.printed = "Failed to load libcudnn.so.9: no such file\nPlease follow the instructions"
    with pytest.raises(UserError) as caught:
        open_engine(str(tiny_graphs), "onnx", device="cuda:1")
    message = str(caught.value)
    assert message.startswith(f"onnxruntime cannot start {CUDA} on cuda:1 (Failed to load libcudnn.so.9: no such file)")
    assert "onnxruntime-gpu[cuda,cudnn]" in message
    assert "\n" not in message
    # standard output belongs to what a command prints for programs
    assert capsys.readouterr().out == ""


def test_a_gpu_that_fails_is_not_a_damaged_file(tiny_graphs: Path, gpu: Gpu) -> None:
    gpu.fails = RuntimeError("x" * 400 + " CUDA failure 101: invalid device ordinal\nat somewhere.cc:7")
    with pytest.raises(UserError, match=r"cannot load .*template\.onnx on cuda:7 \(x+ CUDA failure 101: inv") as caught:
        open_engine(str(tiny_graphs), "onnx", device="cuda:7")
    assert "damaged" not in str(caught.value)
    assert "somewhere" not in str(caught.value)


@pytest.mark.parametrize(("device", "wheel"), [("cpu", "onnxruntime$"), ("cuda", "'onnxruntime-gpu.cuda,cudnn.'$")])
def test_what_is_left_after_one_of_two_wheels_went_is_named(
    tiny_graphs: Path, monkeypatch: pytest.MonkeyPatch, device: str, wheel: str
) -> None:
    monkeypatch.delattr(onnxruntime, "InferenceSession")
    with pytest.raises(UserError, match=f"the installed onnxruntime is incomplete, .* && pip install {wheel}"):
        open_engine(str(tiny_graphs), "onnx", device=device)


def test_the_product_of_the_probe_is_that_graph() -> None:
    onnx = pytest.importorskip("onnx")
    make, kinds = onnx.helper, onnx.TensorProto
    places = {"a": kinds.UINT8, "b": kinds.INT8, "c": kinds.INT32}
    values = {name: make.make_tensor_value_info(name, kind, None) for name, kind in places.items()}
    node = make.make_node("MatMulInteger", ["a", "b"], ["c"])
    graph = make.make_graph([node], "p", [values["a"], values["b"]], [values["c"]])
    expected = make.make_model(graph, opset_imports=[make.make_opsetid("", 10)], ir_version=5)
    assert onnx.ModelProto.FromString(onnx_engine._PRODUCT) == expected


def test_large_products_of_8_bits_are_summed_exactly() -> None:
    onnx = pytest.importorskip("onnx")
    make, kinds = onnx.helper, onnx.TensorProto
    right = onnx.numpy_helper.from_array(np.full((64, 64), -127, np.int8), "b")
    given, sums = (make.make_tensor_value_info(n, k, [64, 64]) for n, k in (("a", kinds.UINT8), ("c", kinds.INT32)))
    graph = make.make_graph([make.make_node("MatMulInteger", ["a", "b"], ["c"])], "p", [given], [sums], [right])
    model = make.make_model(graph, opset_imports=[make.make_opsetid("", 17)], ir_version=8)
    session = onnx_engine.open_session(model.SerializeToString(), 1)
    (found,) = session.run(None, {"a": np.full((64, 64), 255, np.uint8)})
    assert_array_equal(found, np.full((64, 64), -64 * 255 * 127))


@pytest.mark.parametrize("saturates", [True, False])
def test_only_where_sums_saturate_is_the_slower_sum_asked_for(monkeypatch: pytest.MonkeyPatch, saturates: bool) -> None:
    # With VNNI the option would more than double the time of every 8-bit model.
    monkeypatch.setattr(onnx_engine, "products_saturate", lambda: saturates)
    options = onnx_engine.session_options(1)
    if saturates:
        assert options.get_session_config_entry("session.x64quantprecision") == "1"
    else:
        with pytest.raises(RuntimeError):
            options.get_session_config_entry("session.x64quantprecision")
