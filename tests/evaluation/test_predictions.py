"""Pictures of other programs: which held-out image each is of, and what is refused."""

from __future__ import annotations

import json
import shutil
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from PIL import Image

from devrf.apps.records import frame_rows
from devrf.errors import DevrfError
from devrf.evaluation.held_out import score, truth_image
from devrf.evaluation.predictions import picture_name, pictures_in, read_predictions
from devrf.evaluation.scoring import score_held_out, score_pictures
from devrf.evaluation.suite import MetricSuite
from devrf.pictures.images import to_bytes, write_image
from devrf.pictures.video_file import write_pictures
from devrf.rendering.renderer import Renderer


@pytest.fixture
def sets(tiny_scene):
    return {"static": tiny_scene.static.test, "dynamic": tiny_scene.dynamic.test}


@pytest.fixture
def folder(tmp_path, sets) -> Path:
    """The truth itself, a little darker, under the names that devrf gives."""
    for name, views in sets.items():
        for index in range(len(views)):
            dark = truth_image(views, index, "white") * 0.97
            write_image(tmp_path / name / picture_name(views, index), dark)
    return tmp_path


def refused(folder: Path, sets) -> str:
    with pytest.raises(DevrfError) as caught:
        read_predictions(folder, sets, "white")
    line = str(caught.value)
    assert len(line.splitlines()) == 1 and line.startswith(str(folder))
    return line


def scored(folder: Path, sets) -> dict:
    """The scored views of the pictures in a folder, by their set."""
    return {
        name: score_pictures(name, picture, sets[name], "white", MetricSuite())
        for name, picture in read_predictions(folder, sets, "white").items()
    }


def test_own_pictures_score_as_the_model_does(learned, sets, tmp_path):
    """Up to what eight bits of a colour round."""
    model = learned[0].scene_model
    for name, views in sets.items():
        for index in range(len(views)):
            time = 0.0 if name == "static" else None
            view = score(Renderer(model), views, index, "white", time=time)
            write_image(tmp_path / name / picture_name(views, index), view.prediction)
    own = score_held_out(model, sets, "white")
    again = scored(tmp_path, sets)
    for name in sets:
        for first, second in zip(own[name], again[name], strict=True):
            assert (first.name, first.time) == (second.name, second.time)
            assert second.psnr == pytest.approx(first.psnr, abs=0.02)
            assert second.ssim == pytest.approx(first.ssim, abs=1e-3)


def test_every_way_to_say_which_image_it_is(folder, sets, tmp_path):
    views = sets["dynamic"]
    expected = [to_bytes(truth_image(views, k, "white") * 0.97).numpy() for k in range(len(views))]
    names = [picture_name(views, k) for k in range(len(views))]
    assert names == ["view0_time0.0000.png", "view0_time0.5000.png", "view0_time1.0000.png"]
    here = folder / "dynamic"

    def found() -> list[np.ndarray]:
        return [to_bytes(view.prediction).numpy() for view in scored(folder, sets)["dynamic"]]

    def equal() -> bool:
        return all(np.array_equal(a, b) for a, b in zip(found(), expected, strict=True))

    assert equal()
    for k, name in enumerate(names):  # in their order
        (here / name).rename(here / f"{k:05d}.png")
    assert equal()
    for k, image in enumerate(views.names):  # by the images' names
        (here / f"{k:05d}.png").rename(here / f"{Path(image).stem}.png")
    assert equal()
    entries = [
        {"file": f"{Path(views.names[0]).stem}.png", "image": views.names[0]},
        *({"file": f"{Path(views.names[k]).stem}.png", "view": 0, "time": k / 2} for k in (1, 2)),
    ]
    (here / "predictions.json").write_text(json.dumps({"images": entries}))
    assert equal()


def test_pictures_in_their_order_whose_numbers_are_names_of_some_images(folder, sets):
    """As those of Neural 3D Video's images 0, 7 and 14, counted from 0 on."""
    numbered = ("view3/00000.png", "view3/00007.png", "view3/00014.png")
    views = replace(sets["dynamic"], names=numbered)
    for k in range(3):
        (folder / "dynamic" / picture_name(views, k)).rename(folder / "dynamic" / f"{k:05d}.png")
    found = scored(folder, {"dynamic": views})["dynamic"]
    assert [view.name for view in found] == list(numbered) and min(v.psnr for v in found) > 28
    (folder / "dynamic" / "00002.png").unlink()
    line = refused(folder, {"dynamic": views})
    assert "no picture of view3/00007.png" in line and "2 of 3 are missing" in line


def test_pictures_of_thousands_of_times_are_those_of_the_nearest(sets, tmp_path):
    """Times nearer to one another than names are to times: each was that of the next image."""
    one = sets["dynamic"][torch.zeros(2001, dtype=torch.long)]
    views = replace(one, times=torch.arange(2001) / 2000, names=tuple(map(str, range(2001))))
    for index in range(3):
        picture = np.full((views.height, views.width, 3), 10 * index, np.uint8)
        iio.imwrite(tmp_path / picture_name(views, index), picture)
    found = pictures_in(tmp_path, views[torch.arange(3)])
    assert [int(found(index)[0, 0, 0]) for index in range(3)] == [0, 10, 20]


def test_a_name_that_is_misspelt_is_no_order(folder, sets):
    views = replace(sets["dynamic"], names=("r_10.png", "r_1.png", "r_2.png"))
    for k, name in enumerate(("r_10", "r_1", "r_02")):
        (folder / "dynamic" / picture_name(views, k)).rename(folder / "dynamic" / f"{name}.png")
    assert "no picture of r_2.png" in refused(folder, {"dynamic": views})
    placed = picture_name(sets["dynamic"], 0).replace("time0", "time7")
    for k, path in enumerate(sorted((folder / "dynamic").iterdir())):
        path.rename(path.with_name(placed if k == 0 else f"other{k}.png"))
    assert "3 of 3 are missing" in refused(folder, sets)


def test_pictures_have_no_score_of_a_scene_at_rest(folder, sets):
    rows = frame_rows(scored(folder, sets))
    assert [{*row} & {"psnr", "rest_pose_psnr"} for row in rows] == [{"psnr"}] * len(rows)


def test_a_film_and_alpha(folder, sets):
    views = sets["dynamic"]
    for file in (folder / "dynamic").iterdir():
        file.unlink()
    (folder / "dynamic").rmdir()
    frames = [to_bytes(truth_image(views, k, "white")).numpy() for k in range(len(views))]
    write_pictures(folder / "dynamic.mp4", iter(frames), 10)
    for index in range(len(sets["static"])):
        pixels = sets["static"].single(index).pixels[0].numpy()
        iio.imwrite(folder / "static" / picture_name(sets["static"], index), pixels)
    found = scored(folder, sets)
    assert min(view.psnr for view in found["dynamic"]) > 20  # H.264 halves the colours' size
    assert min(view.psnr for view in found["static"]) > 60  # RGBA is put on the background
    shutil.rmtree(folder / "static")
    assert {*scored(folder, sets)} == {"dynamic"}
    (folder / "dynamic.mp4").rename(folder / "static.mp4")
    assert "has 3 frames, but 2 images are held out" in refused(folder, sets)


def test_two_sets_of_one_pose_and_time_have_pictures_of_their_own(sets, tmp_path):
    """As those of what one moving camera films: its held-out views at rest are those in motion."""
    views = sets["static"]
    for name, share in (("static", 0.5), ("dynamic", 0.9)):
        for index in range(len(views)):
            dark = truth_image(views, index, "white") * share
            write_image(tmp_path / name / picture_name(views, index), dark)
    found = scored(tmp_path, {"static": views, "dynamic": views})
    for index, (rest, moved) in enumerate(zip(*found.values(), strict=True)):
        truth = truth_image(views, index, "white")
        assert (rest.prediction - truth * 0.5).abs().max() < 0.01
        assert (moved.prediction - truth * 0.9).abs().max() < 0.01


def test_another_background_is_said_and_scored(folder, sets, caplog):
    read_predictions(folder, sets, "white")
    assert not caplog.records
    for index in range(len(sets["dynamic"])):
        on_black = truth_image(sets["dynamic"], index, "black")
        write_image(folder / "dynamic" / picture_name(sets["dynamic"], index), on_black)
    assert {*read_predictions(folder, sets, "white")} == {"static", "dynamic"}
    (line,) = (record.getMessage() for record in caplog.records)
    assert line.startswith(f"{folder / 'dynamic'}: the images are white")
    # Of a key it says nothing: embedded scenes have no data.background.
    assert line.endswith("scores count it; render the pictures so") and "data." not in line


def test_what_does_not_fit_is_said_in_one_line(folder, sets):
    here = folder / "dynamic"
    first, second, third = sorted(here.iterdir())
    whole = iio.imread(first)
    iio.imwrite(first, whole[::2])
    assert "24x9 px, but " in refused(folder, sets) and "has 24x18" in refused(folder, sets)
    Image.new("L", (9000, 9000)).save(first)
    first.write_bytes(first.read_bytes()[:1000])  # it is not decoded
    assert "9000x9000 px, but " in refused(folder, sets)
    iio.imwrite(first, whole)
    second.rename(folder / "away.png")
    assert "has no picture of " in (line := refused(folder, sets)) and "(time 0.5)" in line
    third.rename(second)
    (folder / "away.png").rename(third)
    assert "2 are in another order" in refused(folder, sets)
    (here / "predictions.json").write_text(json.dumps({"images": [{"file": "../../x.png"}]}))
    assert "leads outside" in refused(folder, sets)


def test_a_name_of_millions_of_folders_is_looked_at_once(folder, sets):
    """And not once for each of 300 held-out images, which took half a minute."""
    here = folder / "dynamic"
    entry = {"file": next(here.iterdir()).name, "image": "a/" * 1_000_000}
    (here / "predictions.json").write_text(json.dumps({"images": [entry]}))
    began = time.monotonic()
    with pytest.raises(DevrfError, match="a picture of none of the held-out images"):
        pictures_in(here, SimpleNamespace(names=["r_0.png"] * 300))
    assert time.monotonic() - began < 10


def test_a_motion_that_was_not_learned_is_no_other_order(folder, sets):
    """All pictures look like the first image."""
    first, *others = sorted((folder / "dynamic").iterdir())
    for other in others:
        other.write_bytes(first.read_bytes())
    assert {*read_predictions(folder, sets, "white")} == {"static", "dynamic"}
