"""Exported networks: ONNX files that contain the checkpoint's header as metadata."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lidar_perception.detectors.checkpoint import KEY, Header
from lidar_perception.runs.files import write_bytes
from lidar_perception.runs.threads import get_thread_count
from lidar_perception.types import InputError

if TYPE_CHECKING:
    import torch

OPSET = 18


def write_onnx(
    path: str | Path,
    network: torch.nn.Module,
    header: Header,
    inputs: Mapping[str, torch.Tensor],
    outputs: Sequence[str],
    dynamic: Mapping[str, Any],
) -> None:
    """Export a network, in eval mode, to an ONNX file.

    Args:
        inputs: example of each input, by name, in the order of the network's arguments.
        outputs: names of the outputs.
        dynamic: dimensions of each input that vary, see torch.export.

    Raises:
        InputError: onnx or onnxscript is not installed.
    """
    try:
        import onnx
        import onnxscript  # noqa: F401
    except ImportError:
        raise InputError(
            "export onnx requires the packages onnx and onnxscript: pip install 'lidar_perception[onnx]'"
        ) from None
    import torch

    logging.getLogger("torch.onnx").setLevel(logging.ERROR)  # hide the warning about missing torchvision
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        program = torch.onnx.export(
            network,
            tuple(inputs.values()),
            dynamo=True,
            verbose=False,
            opset_version=OPSET,
            input_names=list(inputs),
            output_names=list(outputs),
            dynamic_shapes=dict(dynamic),
        )
    assert program is not None  # always set with dynamo=True
    model = program.model_proto
    onnx.helper.set_model_props(model, {KEY: header.to_json()})
    onnx.checker.check_model(model)
    write_bytes(path, model.SerializeToString())


def open_session(path: str | Path) -> tuple[Any, str | None]:
    """Open an exported network in ONNX Runtime, on the CPU.

    Returns:
        The session, and the text of the header, or None if it is missing.

    Raises:
        InputError: onnxruntime is not installed, or the file is missing or invalid.
    """
    try:
        import onnxruntime
    except ImportError:
        raise InputError(f"{path} requires onnxruntime: pip install 'lidar_perception[onnx]'") from None
    if not Path(path).is_file():
        raise InputError(f"exported network not found: {path}")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = get_thread_count()
    try:
        session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        return session, session.get_modelmeta().custom_metadata_map.get(KEY)
    except Exception as error:  # ONNX Runtime's exceptions share no base class
        reason = str(error).splitlines()[0]
        raise InputError(f"ONNX Runtime cannot read {path}: {reason}") from None


def run_session(session: Any, source: str, outputs: Sequence[str], inputs: Mapping[str, Any]) -> list[Any]:
    """Run a session and return its outputs; raise an InputError that names the file `source` if it fails."""
    try:
        return session.run(list(outputs), dict(inputs))
    except Exception as error:  # ONNX Runtime's exceptions share no base class
        raise InputError(f"ONNX Runtime cannot run {source}: {str(error).splitlines()[0]}") from None


def read_exported_header(path: Path) -> Header:
    """Read the header of an exported file.

    Raises:
        InputError: see open_session, or the header is missing or invalid.
    """
    return Header.from_json(open_session(path)[1], str(path))
