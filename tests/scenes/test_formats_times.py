"""Times are read, or said to be missing: none is made up."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from devrf.apps.inspection.advice import advice_on
from devrf.scenes.formats.blender import BlenderReader
from devrf.scenes.formats.nerfstudio import NerfstudioReader


def drop_times(content: dict[str, Any]) -> None:
    for frame in content["frames"]:
        frame.pop("time", None)


@pytest.mark.parametrize(("bare", "timed"), [("test", "train"), ("train", "test")])
def test_in_one_file_and_not_in_the_other(scene_folder, refusal, bare, timed):
    file = scene_folder.dynamic / f"transforms_{bare}.json"
    scene_folder.edit(file, drop_times)
    message = refusal(BlenderReader, scene_folder.root)
    assert message.startswith(f'{file}: its frames have no "time", but those of transforms_{timed}')


def test_held_out_frames_without_times_that_are_fewer_than_those_learned_from(scene_folder, caplog):
    for split in ("train", "test"):
        scene_folder.edit(scene_folder.dynamic / f"transforms_{split}.json", drop_times)
    BlenderReader(scene_folder.root).read()
    assert "without times" not in caplog.text
    file = scene_folder.dynamic / "transforms_test.json"
    scene_folder.edit(file, lambda content: content["frames"].pop(1))
    BlenderReader(scene_folder.root).read()
    assert f"{file}: 2 frames without times, and 3 to learn from" in caplog.text


def test_held_out_of_a_film_without_times_an_image_keeps_its_own(scene_folder):
    """It was at time 0, the one of a set of one, and those around it moved together."""
    file = scene_folder.dynamic / "transforms_train.json"

    def film(content: dict[str, Any]) -> None:
        drop_times(content)
        for k, frame in enumerate(content["frames"]):
            frame["transform_matrix"][0][3] += 0.1 * k

    scene_folder.edit(file, film)
    (scene_folder.dynamic / "transforms_test.json").unlink()
    dynamic = BlenderReader(scene_folder.root).read().dynamic
    assert dynamic.train.times.tolist() == pytest.approx([0.0, 0.2, 0.4, 0.6, 0.8])
    assert dynamic.test.times.tolist() == [1.0]


def test_by_their_order_absent_images_keep_their_times(tmp_path, balls):
    root = tmp_path / "scene"
    balls.write(root, None)
    for k in (3, 4, 5):
        (root / f"images/r_{k:03d}.png").unlink()
    train = NerfstudioReader(root, times="order", missing="skip").read().dynamic.train
    assert train.names[2:4] == ("images/r_002.png", "images/r_006.png")
    assert train.times[2:4].tolist() == [0.25, 0.75]


def test_in_dnerfs_layout(single_folder, scene_folder, refusal):
    file = single_folder / "transforms_test.json"
    scene_folder.edit(file, drop_times)
    assert refusal(BlenderReader, single_folder).startswith(f"{file}: its frames have no ")


def test_of_a_validation_split(single_folder, scene_folder, refusal):
    text = (single_folder / "transforms_test.json").read_text()
    (single_folder / "transforms_val.json").write_text(text)
    scene_folder.edit(single_folder / "transforms_val.json", drop_times)
    message = refusal(BlenderReader, single_folder, validation=True)
    assert message.startswith(f"{single_folder}/transforms_val.json: its frames have no ")


def test_a_static_set_is_at_rest_whatever_times_a_converter_gave_it(scene_folder):
    def as_a_film(content: dict[str, Any]) -> None:
        for k, frame in enumerate(content["frames"]):
            frame["time"] = k / len(content["frames"])

    for split in ("train", "test"):
        scene_folder.edit(scene_folder.static / f"transforms_{split}.json", as_a_film)
    scene = BlenderReader(scene_folder.root).read()
    assert not scene.static.train.times.any() and not scene.static.test.times.any()
    assert scene.clock.times == (0.0, 0.5, 1.0)


def test_one_time_for_all_is_as_good_as_none(scene_folder):
    def at_zero(content: dict[str, Any]) -> None:
        for frame in content["frames"]:
            frame["time"] = 0.0

    scene_folder.edit(scene_folder.static / "transforms_train.json", at_zero)
    assert not BlenderReader(scene_folder.root).read().static.train.times.any()


def test_poses_that_come_again_without_times(tmp_path, balls, caplog):
    root = tmp_path / "scene"
    balls.write(root, [0.0] * 24)

    def by_four_cameras(content: dict[str, Any]) -> None:
        drop_times(content)
        for k, frame in enumerate(content["frames"]):
            frame["transform_matrix"] = content["frames"][k % 4]["transform_matrix"]
            frame["timestep_index"] = k // 4

    balls.edit(root, by_four_cameras)
    scene = NerfstudioReader(root).read()
    assert (
        f"{root}/transforms.json: 24 of 24 images are by cameras that stand still, as if the scene "
        'moved, but is learned at rest; if it moves, give each frame its "time" in [0, 1], not '
        '"timestamp" or "timestep_index"'
    ) in caplog.messages
    assert any("that stand still" in str(advice) for advice in advice_on(scene))


def test_a_moving_camera_that_comes_back_is_no_tripod(tmp_path, balls, caplog):
    root = tmp_path / "scene"
    balls.write(root, [0.0] * 24)

    def end_where_it_began(content: dict[str, Any]) -> None:
        drop_times(content)
        content["frames"][-1]["transform_matrix"] = content["frames"][0]["transform_matrix"]

    balls.edit(root, end_where_it_began)
    NerfstudioReader(root).read()
    assert "stand" not in caplog.text


def test_held_out_images_that_were_never_rendered(single_folder, caplog):
    """Two images in place of every eighth one are held out of the training images."""
    for image in (single_folder / "test").iterdir():
        image.unlink()
    scene = BlenderReader(single_folder).read()
    assert scene.dynamic.test.names == ("train/r_007.png",)
    assert scene.dynamic.train.names == tuple(f"train/r_00{k}.png" for k in range(7))
    assert torch.equal(scene.dynamic.train.times, torch.arange(7) / 7)
    assert (
        f"{single_folder}/transforms_test.json: no image of it is there; 1 of the 8 of "
        "transforms_train.json are held out in their place"
    ) in caplog.messages


def test_then_the_validation_images_are_taken_first(single_folder):
    text = (single_folder / "transforms_test.json").read_text()
    (single_folder / "transforms_val.json").write_text(text.replace("test/", "val/"))
    (single_folder / "test").rename(single_folder / "val")
    assert BlenderReader(single_folder).read().dynamic.test.names[0] == "val/r_000.png"


def test_of_fixed_cameras_one_is_held_out(scene_folder, caplog):
    train = scene_folder.dynamic / "transforms_train.json"

    def third_camera(content: dict[str, Any]) -> None:
        poses = [frame["transform_matrix"] for frame in content["frames"][:2]]
        high = [[*row[:3], row[3] + 0.1] for row in poses[0][:3]]
        for k, frame in enumerate(content["frames"]):
            frame["transform_matrix"] = (*poses, high)[k % 3]
            frame["time"] = float(k // 3)

    scene_folder.edit(train, third_camera)
    (scene_folder.dynamic / "transforms_test.json").unlink()
    dynamic = BlenderReader(scene_folder.root).read().dynamic
    assert dynamic.test.names == tuple(f"dynamic_2views/train/r_00{k}.png" for k in (2, 5))
    assert dynamic.train.view.tolist() == [0, 1, 0, 1]
    assert "2 of the 6 of transforms_train.json are held out" in caplog.text


def test_of_two_cameras_none_can_be_held_out(scene_folder, refusal):
    (scene_folder.dynamic / "transforms_test.json").unlink()
    message = refusal(BlenderReader, scene_folder.root)
    listing = scene_folder.dynamic / "transforms_test.json"
    assert message.startswith(f"{listing}: no image of it is there, and transforms_train.json has")
    listing.write_text((scene_folder.dynamic / "transforms_train.json").read_text())
    dynamic = BlenderReader(scene_folder.root).read().dynamic
    assert dynamic.test.names == dynamic.train.names
