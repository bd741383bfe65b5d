"""Light fields of events through turbulence, for code of your own: docs/python.md.

    from lightfield_events import Runtime, load, read_events, simulate, voxel_grid, write_video

What a name needs is imported when it is first used.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from src.app.python_interface import SimulatedClip, simulate
    from src.deploy.runtime import EventListRuntime as Runtime
    from src.models import load
    from src.recordings.files import ReadOptions, read_events
    from src.recordings.output import write_video
    from src.recordings.views import Views, load_views
    from src.sim.optics import layout
    from src.sim.voxel import voxel_grid

__all__ = [
    "ReadOptions", "Runtime", "SimulatedClip", "Views", "layout", "load", "load_views",
    "read_events", "simulate", "voxel_grid", "write_video",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    home: Any
    if name in ("SimulatedClip", "simulate"):
        from src.app import python_interface as home
    elif name == "Runtime":
        from src.deploy import runtime

        return runtime.EventListRuntime
    elif name == "load":
        from src import models as home
    elif name in ("ReadOptions", "read_events"):
        from src.recordings import files as home
    elif name == "write_video":
        from src.recordings import output as home
    elif name in ("Views", "load_views"):
        from src.recordings import views as home
    elif name == "layout":
        from src.sim import optics as home
    elif name == "voxel_grid":
        from src.sim import voxel as home
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(home, name)


def __dir__() -> list[str]:
    return __all__
