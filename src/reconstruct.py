"""From a recording to video: python -m src.reconstruct recording=cap.raw views=views.yaml ckpt=...

Writes the video and `frames.csv`: the time stamp and the events of each frame.  With
`output_format=film` the video shows events, one view, all views and, of a simulated recording, the
clean clip, side by side.
"""

import re
import time
from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import chain
from pathlib import Path

import numpy as np
import torch
from omegaconf import DictConfig
from rich.progress import BarColumn, Progress, TimeElapsedColumn

from src.app import console, entry_point, methods
from src.deploy.runtime import EventListRuntime, fastest_form, supports_event_lists
from src.figures import samples
from src.models.backward_warmup import check_backward_warmup_s
from src.models.network import EventToVideoNetwork
from src.recordings import output, reconstruction, tone, truth_file
from src.recordings.event_windows import Window, WindowRule, build_window_rule, cut_windows
from src.recordings.files import recording_inputs
from src.recordings.files.event_file import HeightWidth, ReadOptions
from src.recordings.noise_filter import check_noise_filter_s
from src.recordings.reconstruction import Frame
from src.recordings.sensor_lookup import build_lookup
from src.recordings.truth_file import CleanClip
from src.recordings.views import Views
from src.records import results

SLOW_RUN_S = 10.0
RULE_KEYS = ("fps", "bins", "splat", "start_s", "end_s", "noise_filter_s")


def reconstruct(cfg: DictConfig) -> Path:
    """Reconstruct `cfg.recording` frame by frame.  Returns the folder of the video.

    Raises ValueError for a recording, views, network or window that do not go together.
    """
    run, count, first_s, last_s = Path(cfg.paths.run), 0, 0.0, 0.0
    check_settings(cfg)
    video = run / output.KINDS[cfg.output_format][1]
    network = reconstruction.require_event_network(methods.load_ckpt_or_baseline(cfg))
    views = choose_views(cfg, network)
    make = reconstruct_film_frames if cfg.output_format == "film" else reconstruct_video_frames
    start = time.perf_counter()
    frames, size = make(cfg, network, views)
    shown = show_progress(frames, cfg.start_s + 1 / cfg.fps)
    first = next(shown)  # what is refused is so before a file is made
    print_replaced_outputs(video)
    with (
        results.store_config_when_done(run, entry_point.resolved_yaml(cfg)),
        output.open_video_writer(cfg.output_format, run, size, cfg.playback_fps) as write,
    ):
        for frame in chain([first], shown):
            write(frame)
            last_s, count = time.perf_counter() - start, count + 1
            first_s = first_s or last_s
    said = describe_run(video, size, len(views.views), count, first_s, last_s)
    print(said + describe_playback(cfg) + suggest_faster_form(cfg, network, last_s))
    return run


def print_replaced_outputs(video: Path) -> None:
    """Print what of `video` and its table is there and will be replaced, and which videos of other
    formats stay, which the new table does not describe."""
    table = video.parent / "frames.csv"
    for path in (video, table):
        console.print_replaced_path(path)
    names = sorted({name for _, name in output.KINDS.values()} - {video.name})
    if others := [name for name in names if (video.parent / name).exists()]:
        kept = f"{', '.join(others)} of an earlier run"
        print(f"{video.parent} keeps {kept}; frames.csv and config.yaml will be of {video.name}")


def check_settings(cfg: DictConfig) -> None:
    """Raise ValueError for a device, a filter, a warmup or a video that cannot be."""
    check_device(cfg.device)
    output.check_video_settings(cfg.output_format, Path(cfg.paths.run), cfg.playback_fps)
    tone.build_output_curve(cfg.tone, cfg.tone_time_constant_s, cfg.output_format)
    check_backward_warmup_s(cfg.backward_warmup_s)
    if cfg.noise_filter_s is not None:
        check_noise_filter_s(cfg.noise_filter_s)


def check_device(device: str) -> None:
    """Raise ValueError for a `device` other than cpu, cuda or cuda:0, cuda:1, ... of a GPU here."""
    if not re.fullmatch(r"cpu|cuda(:\d+)?", device):
        raise ValueError(f"device must be cpu or cuda, got {device}")
    gpus = torch.cuda.device_count()
    if device != "cpu" and int(device.partition(":")[2] or 0) >= gpus:
        raise ValueError(f"device must be cpu, as torch finds {gpus} GPUs here, got {device}")


def describe_run(
    video: Path, size: HeightWidth, number: int, count: int, first_s: float, last_s: float
) -> str:
    """Return where the video of `number` views is and how fast its `count` frames came, the last
    after `last_s`; the first, after `first_s`, for which code is compiled, does not count as speed.
    """
    (height, width), later_s = size, last_s - first_s
    rate = f"{(count - 1) / later_s:.1f} frames per second of wall time" if later_s else ""
    speed = f", after the first frame {rate}, reading and writing included" if later_s else ""
    frames, views = f"frame{'s' * (count > 1)}", f"view{'s' * (number > 1)}"
    return (
        f"{video}: {count} {frames}, {width}x{height} px, {number} {views}; {last_s:.1f} s, "
        f"of which {first_s:.1f} s prepare the network and give the first frame{speed}; "
        f"times in {video.parent / 'frames.csv'}"
    )


def describe_playback(cfg: DictConfig) -> str:
    """Return at what share of real time a film is shown, to add to the line of a run; "" of frames
    that have no rate."""
    if cfg.output_format not in ("mp4", "gif", "film"):
        return ""
    slower = cfg.fps / cfg.playback_fps
    times = f"{max(slower, 1 / slower):.3g} times {'slower' if slower > 1 else 'faster'}"
    speed = "in real time" if slower == 1 else f"{times} than real time"
    return f"; shown at playback_fps={cfg.playback_fps:g}, {speed}"


def suggest_faster_form(cfg: DictConfig, network: EventToVideoNetwork, run_s: float) -> str:
    """Return what to add to the line of a run of `run_s` that form=openvino would have shortened,
    else ""."""
    is_slow = cfg.form == "float32" and cfg.device == "cpu" and run_s > SLOW_RUN_S
    faster = is_slow and fastest_form() == "openvino" and supports_event_lists(network)
    return "; form=openvino is faster here" if faster else ""


def show_progress(frames: Iterable[Frame], first_s: float) -> Iterator[Frame]:
    """Yield `frames`, and show how many there were and how far in the recording they are, the first
    `first_s` after its beginning, whatever its clock."""
    columns = "{task.description}", BarColumn(), "{task.completed:.0f} frames,", "{task.fields[at]}"
    with Progress(*columns, TimeElapsedColumn()) as progress:
        task = progress.add_task("reconstruction", total=None, at="0.00 s")
        start_s = None
        for frame in frames:
            yield frame
            start_s = frame.time_s - first_s if start_s is None else start_s
            progress.update(task, advance=1, at=f"{frame.time_s - start_s:.2f} s")
        progress.update(task, total=progress.tasks[0].completed)


def choose_views(cfg: DictConfig, network: EventToVideoNetwork) -> Views:
    """Return the views of the recording that the network takes."""
    given = cfg.sensor_size, ReadOptions.from_keys(cfg), cfg.resolution
    views = recording_inputs.find_views(cfg.recording, cfg.views, *given)
    all_of_them = reconstruction.takes_all_views(network, views.positions, cfg.views)
    return views if all_of_them else views.select([(0, 0)])


def reconstruct_video_frames(
    cfg: DictConfig, network: EventToVideoNetwork, views: Views
) -> tuple[Iterator[Frame], HeightWidth]:
    """Return the frames of the recording, as `tone` shows them, and their size."""
    curve = tone.build_output_curve(cfg.tone, cfg.tone_time_constant_s, cfg.output_format)
    given = cfg.form, cfg.device, views, cfg.bins
    runnable = reconstruction.build_runnable_network(network, *given)
    rule = build_window_rule_from_config(cfg, network)
    rule = replace(rule, as_lists=isinstance(runnable, EventListRuntime))

    def read() -> Iterator[np.ndarray]:
        return iter_recorded_events(cfg, views)

    options = views, rule, cfg.backward_warmup_s
    frames = reconstruction.reconstruct_recording(read, runnable, *options, device=cfg.device)
    shown = (replace(one, picture=curve.apply(one.picture, one.time_s)) for one in frames)
    return shown, views.model


def build_window_rule_from_config(cfg: DictConfig, network: EventToVideoNetwork) -> WindowRule:
    """Return how the recording is cut into windows for `network`."""
    length = cfg.window_length or reconstruction.default_window_length(network)
    return build_window_rule(length, **{key: cfg[key] for key in RULE_KEYS})


def iter_recorded_events(cfg: DictConfig, views: Views) -> Iterator[np.ndarray]:
    """Yield the events of the recording."""
    options = ReadOptions.from_keys(cfg)
    return recording_inputs.iter_recording(cfg.recording, views.sensor, options=options)


def reconstruct_film_frames(
    cfg: DictConfig, network: EventToVideoNetwork, views: Views
) -> tuple[Iterator[Frame], HeightWidth]:
    """Return the frames of the film, panels beside each other, and their size.

    The panel of one view shows what the same network makes of the centre view; there is none of a
    network for another number of views.
    """
    number, centre = len(views.views), views
    title = "one view" if number == 1 else f"{number} views"
    methods = {title: reconstruct_video_frames(cfg, network, views)[0]}
    if number > 1:
        centre = views.select([(0, 0)])
        if network.views is None:
            methods = {"one view": reconstruct_video_frames(cfg, network, centre)[0]} | methods
    rule = replace(build_window_rule_from_config(cfg, network), bins=1)
    if rule.grows:  # the panel of events shows those of a frame
        rule = replace(rule, frames_per_window=1, grows=False)
    windows = cut_windows(iter_recorded_events(cfg, views), build_lookup(centre), rule)
    clean = truth_file.read_clean_clip(Path(cfg.recording))
    frames = join_film_panels(windows, methods, clean)
    first = next(frames)
    height, width = first.picture.shape[:2]
    return chain([first], frames), (height, width)


def join_film_panels(
    windows: Iterator[Window], methods: dict[str, Iterator[Frame]], clean: CleanClip | None
) -> Iterator[Frame]:
    """Yield frames of panels: the events of each window, the frames of the methods and, where it is
    known, the clean clip at that moment.
    """
    for window, *shown in zip(windows, *methods.values(), strict=False):
        assert window.voxels is not None
        title = samples.title_events(window.length_s)
        panels = {title: samples.render_events(window.voxels[0], full=1.0)}
        panels |= {name: one.picture[None] for name, one in zip(methods, shown, strict=True)}
        if clean is not None:
            size = shown[-1].picture.shape
            panels["clean"] = clean.nearest_frame(window.end_us * 1e-6, size)[None]
        yield replace(shown[-1], picture=samples.join_panels(panels)[0])


if __name__ == "__main__":
    entry_point.run_command(reconstruct, "reconstruct")
