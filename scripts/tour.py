"""The ten pictures of docs/tour.md: python -m scripts.tour [--index 0].

One simulated clip on its way from scene to video, docs/figures/tour/1_scene.png ...
"""

import argparse

import cv2
import numpy as np
import torch

from scripts.readme import AIR, HOME, NINE, ONE, load_shipped, reconstruct_clip
from src.app import simulation
from src.app.compose import compose_config
from src.app.script import run_script
from src.figures.samples import join_panels, place_views_at_apertures, render_events
from src.recordings import simulated_recording
from src.recordings.output import round_to_uint8
from src.records.atomic import atomic_path
from src.sim.pipeline import ClipParameters, Pipeline

OUT = HOME / "docs" / "figures" / "tour"
SIDE, WINDOWS, PITCH = 192, 40, 24  # pixels of a frame; length of the clip; pixels between stars
STARS_PX, GAMMA = 72, 1.5  # of the part of a frame with stars that is shown


def grey_to_rgb(grey: np.ndarray) -> np.ndarray:
    """Return (..., h, w) in [0, 1] as (..., h, w, 3)."""
    return np.repeat(grey[..., None], 3, -1)


def save(name: str, panels: dict[str, np.ndarray], scale: int = 2) -> None:
    """Write pictures (h, w, 3), `scale` times enlarged, side by side, as `name`.png."""
    large = {
        title: picture[None].repeat(scale, 1).repeat(scale, 2) for title, picture in panels.items()
    }
    eight = round_to_uint8(join_panels(large)[0, ..., ::-1])
    path = OUT / f"{name}.png"
    with atomic_path(path) as partial:
        packed = cv2.imencode(".png", eight, [cv2.IMWRITE_PNG_COMPRESSION, 9])[1]
        partial.write_bytes(packed.tobytes())
    print(f"{path}: {path.stat().st_size // 1000} kB")


def outline(picture: np.ndarray) -> np.ndarray:
    """Return a picture (h, w, 3) with a grey border: white ones side by side are told apart."""
    return np.pad(picture[1:-1, 1:-1], ((1, 1), (1, 1), (0, 0)), constant_values=0.6)


def stars(pipeline: Pipeline, draw: ClipParameters) -> np.ndarray:
    """Return what two neighbouring views make of a grid of points: the PSF of each place, moved by
    the tilt there; with GAMMA, white from half of the largest value on."""
    points = torch.zeros_like(draw.clip.frames[:1])
    points[:, PITCH // 2 :: PITCH, PITCH // 2 :: PITCH] = 1
    air, drawer = pipeline.turbulence_operator(draw), pipeline.turbulence_generator(draw)
    seen = air.degrade(points[None], drawer)[0, :2, 0].numpy()
    return np.clip(2 * seen / seen.max(), 0, 1) ** (1 / GAMMA)


def chip(pipeline: Pipeline, draw: ClipParameters, views: torch.Tensor) -> np.ndarray:
    """Return the events of four windows of all views on one sensor, as a kaleidoscope puts them."""
    camera = simulated_recording.kaleidoscope_views(
        list(pipeline.optics.positions), model=(SIDE, SIDE), sensor=(400, 400), tile_px=128.0,
        key=draw.key,
    )  # fmt: skip
    events = simulated_recording.record_events(views[:, -5:], draw.clip.fps, camera, draw.sensor)
    counts = np.zeros(camera.sensor, np.float32)
    np.add.at(counts, (events["y"], events["x"]), events["p"])
    return render_events(counts[None])[0]


def draw_all(index: int) -> None:
    """Simulate the clip and draw it stage by stage."""
    cfg = compose_config("simulate", *AIR, "fps=120", f"scene.height={SIDE}", f"scene.width={SIDE}",
                 "sensor.threshold=0.15", f"data.test_windows={WINDOWS}")  # fmt: skip
    pipeline = simulation.build_pipeline(cfg, "test")
    draw, middle = pipeline.draw(index), SIDE // 2
    views = pipeline.render_views([draw])[0]
    sample = pipeline.simulate_sensor([draw], views[None])
    tilt, voxels = pipeline.tilt(draw)[:, -1], sample.voxels[0, -1]
    centre = pipeline.optics.centre
    truth, seen = sample.target[0, :, 0].numpy(), sample.turbulent[0, :, 0].numpy()
    one, nine = (
        reconstruct_clip(load_shipped(*which), sample)[:, 0].numpy() for which in (ONE, NINE)
    )
    reach = float(tilt.abs().max())

    save("1_scene", {"first frame": grey_to_rgb(truth[0]), "last frame": grey_to_rgb(truth[-1])})
    right, down = render_events(tilt[centre].numpy(), full=reach)
    save("2_tilt", {f"tilt in x, to {reach:.1f} px": right, "tilt in y": down})
    first, second = map(grey_to_rgb, stars(pipeline, draw)[:, :STARS_PX, :STARS_PX])
    save("3_psfs", {"points through one view": first, "through its neighbour": second}, scale=6)
    grid = place_views_at_apertures(
        [grey_to_rgb(view[-1:].numpy()) for view in views], pipeline.optics
    )[0]
    save("4_views", {"what the nine views see": grid}, scale=1)
    save("5_sensor", {"events of 1/30 s on one sensor": chip(pipeline, draw, views)}, scale=1)
    events = render_events(voxels.sum(1).numpy())[centre : centre + 2]
    save(
        "6_events",
        dict(zip(("events of the centre view", "of its neighbour"), events, strict=True)),
    )
    bins = render_events(voxels[centre].numpy(), full=1.5)
    save("7_voxels", {f"bin {k}": outline(part[32:160, 32:160]) for k, part in enumerate(bins)})
    last = {"ground truth": grey_to_rgb(truth[-1])}
    save("8_one_view", {"one view, reconstructed": grey_to_rgb(one[-1])} | last)
    save("9_nine_views", {"nine views, reconstructed": grey_to_rgb(nine[-1])} | last)
    films = {"the view": seen, "one view": one, "nine views": nine, "ground truth": truth}
    stretched = {name: film[:, middle].repeat(3, 0) for name, film in films.items()}
    save("10_slices", {name: grey_to_rgb(film) for name, film in stretched.items()})


def main() -> None:
    """Read the arguments."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--index", type=int, default=0, help="the test clip")
    draw_all(parser.parse_args().index)


if __name__ == "__main__":
    run_script(main)
