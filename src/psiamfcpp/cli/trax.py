"""`psiamfcpp trax`."""

from __future__ import annotations

from pathlib import Path

from psiamfcpp.zoo import DEFAULT_MODEL


def trax(
    model: str = DEFAULT_MODEL,
    engine: str | None = None,
    threads: int | None = None,
    search_size: int | None = None,
    plain: bool = False,
) -> None:
    """Serve a tracker to vot-toolkit, or any other client of the TraX protocol.

    The client starts this command and talks to it over standard input and output, or over the port that TRAX_SOCKET
    names. An entry of vot-toolkit's trackers.ini needs `protocol = trax` and `command = psiamfcpp trax --plain`.

    Args:
        model: name of a shipped model, or a model file.
        engine: what runs the network: onnx, openvino or torch; by default onnx for graphs and torch for a checkpoint.
        threads: threads of the tracker; by default all cores.
        search_size: side of the search crop in pixels.
        plain: the published procedure, without states and without search for a lost target.
    """
    from psiamfcpp.trackers.adapters.trax_worker import claim_streams

    # before the model is opened, so that nothing printed on the way gets into the protocol
    streams = claim_streams()
    from psiamfcpp import Tracker
    from psiamfcpp.trackers.trax.server import serve_trax

    name = Path(model).stem if Path(model).exists() else model
    tracker = Tracker(model, engine=engine, threads=threads, search_size=search_size, plain=plain)
    serve_trax(tracker, name, streams)
