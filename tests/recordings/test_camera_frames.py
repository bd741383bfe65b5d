"""Reconstructions against the frames of a camera on the same clock."""

from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest

from src.recordings import camera_frames

FPS, FRAMES = 10, 8


@pytest.fixture
def recording(tmp_path) -> tuple[Path, Path]:
    """A folder of pictures with its frames.csv, and the list of a camera that saw each of them."""
    video, camera = tmp_path / "run" / "frames", tmp_path / "camera"
    video.mkdir(parents=True)
    camera.mkdir()
    rng, rows, lines = np.random.default_rng(0), ["frame,time_s"], []
    for k in range(FRAMES):
        picture = cv2.GaussianBlur(rng.integers(0, 255, (48, 48)).astype(np.uint8), (9, 9), 2)
        for folder in (video, camera):
            cv2.imwrite(str(folder / f"{k:07d}.png"), picture)
        rows.append(f"{k},{k / FPS}")
        lines.append(f"{k / FPS + 0.01} {k:07d}.png")
    (video.parent / "frames.csv").write_text("\n".join(rows))
    (camera / "images.txt").write_text("\n".join(lines))
    return video, camera / "images.txt"


def test_a_video_agrees_with_itself_and_not_with_the_next_frames(recording):
    video, listing = recording
    same = camera_frames.score_against_camera(video, listing)
    assert same["ssim"] > 0.999 and same["correlation"] > 0.999 and same["lpips"] < 1e-4
    for path in video.iterdir():
        cv2.imwrite(str(path), 100 + cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) // 2)
    pale = camera_frames.score_against_camera(video, listing)
    assert pale["lpips"] > 0.01 > 5 * pale["lpips_aligned"] and pale["correlation"] > 0.99
    names = [line.split()[1] for line in listing.read_text().splitlines()]
    late = [f"{k / FPS} {name}" for k, name in enumerate(names[1:])]
    listing.write_text("\n".join(late))
    other = camera_frames.score_against_camera(video, listing)
    assert other["ssim"] < 0.8 and abs(other["correlation"]) < 0.5 and other["lpips"] > 0.05


def test_what_is_not_there_or_not_at_the_same_time_is_named(recording):
    video, listing = recording
    with pytest.raises(ValueError, match="reference_images must be the list of a camera's frames"):
        camera_frames.score_against_camera(video, listing.with_name("none.txt"))
    given = listing.read_text()
    listing.write_text("a b c")
    with pytest.raises(ValueError, match="reference_images must have seconds and a file in each"):
        camera_frames.score_against_camera(video, listing)
    listing.write_text("# t file\n\n" + given)
    assert camera_frames.score_against_camera(video, listing)["ssim"] > 0.999
    cv2.imwrite(str(listing.parent / "0000003.png"), np.zeros((24, 24), np.uint8))
    with pytest.raises(ValueError, match="reference_images must have the video's size"):
        camera_frames.score_against_camera(video, listing)
    table = video.parent / "frames.csv"
    table.write_text("\n".join(table.read_text().splitlines()[:-2]))
    with pytest.raises(ValueError, match="frames.csv is of another video, 6 lines for 8 frames"):
        camera_frames.score_against_camera(video, listing)
    listing.write_text("99.0 0000000.png")
    table.write_text("frame,time_s\n" + "\n".join(f"{k},{k / FPS}" for k in range(FRAMES)))
    with pytest.raises(ValueError, match="reference_images must have frames within the video"):
        camera_frames.score_against_camera(video, listing)


def test_a_video_h5_has_its_own_clock(recording):
    folder, listing = recording
    film = np.stack([cv2.imread(str(path), 0) for path in sorted(folder.iterdir())])
    with h5py.File(folder.parent / "video.h5", "w") as file:
        file["frames"], file["time_s"] = film, np.arange(FRAMES) / FPS
    (folder.parent / "frames.csv").write_text("frame,time_s\n0,7.0\n1,8.0")  # of a later run
    scores = camera_frames.score_against_camera(folder.parent / "video.h5", listing)
    assert scores["ssim"] > 0.999 and scores["correlation"] > 0.999


def test_a_picture_may_have_any_name(recording):
    folder, listing = recording
    (listing.parent / "0000002.png").rename(listing.parent / "take #2.png")
    listing.write_text(f"{2 / FPS} take #2.png")
    assert camera_frames.score_against_camera(folder, listing)["ssim"] > 0.999
