"""Light fields of events through turbulence, for code of your own: docs/python.md.

    from lightfield_events import Runtime, load, read_events, simulate, voxel_grid, write_video

What a name needs is imported when it is first used.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from src.app.python_interface import SimulatedClip, simulate
    from src.deploy.forms import convert_to_form
    from src.deploy.onnx_export import OnnxNetwork, export_onnx
    from src.deploy.runtime import EventListRuntime as Runtime
    from src.models.files import load
    from src.recordings.files import ReadOptions, read_events
    from src.recordings.output import write_video
    from src.recordings.views import Views, load_views
    from src.sim.optics import layout
    from src.sim.voxel import voxel_grid

_HOMES = {  # of each name: its module, and there its name
    "OnnxNetwork": "src.deploy.onnx_export.OnnxNetwork",
    "ReadOptions": "src.recordings.files.ReadOptions",
    "Runtime": "src.deploy.runtime.EventListRuntime",
    "SimulatedClip": "src.app.python_interface.SimulatedClip",
    "Views": "src.recordings.views.Views",
    "convert_to_form": "src.deploy.forms.convert_to_form",
    "export_onnx": "src.deploy.onnx_export.export_onnx",
    "layout": "src.sim.optics.layout",
    "load": "src.models.files.load",
    "load_views": "src.recordings.views.load_views",
    "read_events": "src.recordings.files.read_events",
    "simulate": "src.app.python_interface.simulate",
    "voxel_grid": "src.sim.voxel.voxel_grid",
    "write_video": "src.recordings.output.write_video",
}
__all__ = [
    "OnnxNetwork", "ReadOptions", "Runtime", "SimulatedClip", "Views", "convert_to_form",
    "export_onnx", "layout", "load", "load_views", "read_events", "simulate", "voxel_grid",
    "write_video",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from src import add_package_prefix

    module, _, there = _HOMES[name].rpartition(".")
    return getattr(import_module(add_package_prefix(module)), there)


def __dir__() -> list[str]:
    return __all__
