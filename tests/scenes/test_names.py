"""Names of images: their order, and the file that a name in a list means."""

from __future__ import annotations

import logging
import unicodedata
from collections.abc import Callable
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
import torch

from devrf.scenes.footage import pictures
from devrf.scenes.formats.blender import BlenderReader
from devrf.scenes.formats.llff import LlffReader
from devrf.scenes.formats.nerfstudio import NerfstudioReader
from devrf.scenes.image_folders import listed_images
from devrf.scenes.names import in_order


@pytest.mark.parametrize(
    "names",
    [
        ["frame_1.png", "frame_2.png", "frame_10.png"],
        ["100.png", "100.25.png", "100.5.png", "101.png"],  # loggers leave zeros out
        ["100.0.png", "100.125.png", "100.25.png"],
        ["take1.9.png", "take1.10.png", "take1.11.png"],  # a counter: a decimal has no such zero
        ["1.2.9.png", "1.2.10.png"],
        ["left2/9.png", "left10/1.png"],
        ["1403636579763555584.png", "1403636579813555456.png"],
        ["100.25", "100.5"],  # without suffix
        ["a09.jpeg", "a9.jpeg", "b1.jpeg"],  # equal numbers: by characters
    ],
)
def test_numbers_in_names_count(names: list[str]) -> None:
    assert in_order(reversed(names), name=str, where="here") == names


def test_by_characters_where_rows_count_on_it(caplog):
    caplog.set_level(logging.INFO)
    names = ["frame_1.png", "frame_2.png", "frame_10.png"]
    assert in_order(names, name=str, where="images", by_characters=True) == sorted(names)
    assert in_order(["a01", "a02"], name=str, where="other", by_characters=True) == ["a01", "a02"]
    (line,) = [record.getMessage() for record in caplog.records]
    assert line == (
        "images: names are in the order of their characters: frame_10.png before frame_2.png"
    )


def _numbered(folder: Path, count: int) -> None:
    """Images 0.png, 1.png … whose grey is ten times their number."""
    folder.mkdir(parents=True)
    for k in range(count):
        iio.imwrite(folder / f"{k}.png", np.full((16, 16, 3), 10 * k, np.uint8))


def test_photographs_are_a_film_by_number(tmp_path, caplog):
    caplog.set_level(logging.INFO)
    _numbered(tmp_path / "film", 12)
    shown = [int(picture[0, 0, 0]) // 10 for _, picture in pictures(tmp_path / "film")]
    assert shown == list(range(12))
    assert "in the order of their numbers: 2.png before 10.png" in caplog.text


def test_a_video_of_llffs(llff_folder):
    """Its rows are in the order of characters, its times in that of numbers."""
    root = llff_folder.root / "static"
    for file in (root / "images_4").iterdir():
        file.unlink()
    for k in range(9):
        # 8, 9, 10 …: characters put 10.png first.
        iio.imwrite(root / f"images_4/{k + 8}.png", np.full((16, 24, 3), 10 * k, np.uint8))
    rows = listed_images(root / "images_4", by_characters=True)
    assert rows[0].name == "10.png"
    views = LlffReader(root, monocular=True, holdout=9).read().dynamic.train
    assert views.names == tuple(f"images_4/{k + 8}.png" for k in range(8))
    assert torch.equal(views.times, torch.arange(8) / 8)
    # The first row's camera is that of 10.png, the third image of the video.
    rest = LlffReader(root, holdout=9).read().static
    camera = rest.test.cameras.camera_to_world[0]
    assert rest.test.names == ("images_4/10.png",)
    assert torch.allclose(views.cameras.camera_to_world[2], camera)


def _listed_as(scene_folder, spell: Callable[[str], str]) -> None:
    scene_folder.edit(
        scene_folder.static / "transforms_train.json",
        lambda content: [
            frame.update(file_path=spell(f"{frame['file_path'][2:]}.png"))
            for frame in content["frames"]
        ],
    )


@pytest.mark.parametrize(
    "spell",
    [
        lambda name: name.replace("/", "\\"),
        lambda name: ".\\" + name.replace("/", "\\"),
        lambda name: name.replace(".png", ""),
        lambda name: name.replace(".png", ".PNG"),
        lambda name: name.replace("train", "Train"),
        lambda name: name.replace(".png", ".jpg"),
        lambda name: f"/home/someone/scan/{name}",
        lambda name: f"/home/someone/scan/static/{name}",
        lambda name: "C:\\scan\\" + name.replace("/", "\\"),
    ],
)
def test_other_spellings_of_a_name(scene_folder, spell):
    names = BlenderReader(scene_folder.root).read().static.train.names
    _listed_as(scene_folder, spell)
    assert BlenderReader(scene_folder.root).read().static.train.names == names


@pytest.mark.parametrize("relative", [False, True])
def test_an_absolute_path_below_the_scene_is_not_from_elsewhere(
    scene_folder, caplog, monkeypatch, relative
):
    root = scene_folder.root
    monkeypatch.chdir(root.parent)
    _listed_as(scene_folder, lambda name: str(root / "static" / name))
    with caplog.at_level(logging.INFO):
        BlenderReader(root.name if relative else root).read()
    assert "taken from below" not in caplog.text


@pytest.mark.parametrize("outside", ["/etc/passwd", "C:\\x\\y.png", "..\\..\\..\\a.png"])
def test_what_leads_outside_is_refused(scene_folder, refusal, outside):
    _listed_as(scene_folder, lambda name: outside)
    assert "leads outside the scene's folder" in refusal(BlenderReader, scene_folder.root)


@pytest.mark.parametrize("name", ["/a" * 100_000, "a" * 10_000, "../" + "9" * 5000])
def test_names_that_no_file_can_have_are_not_looked_for(scene_folder, refusal, name):
    """Of a path of another machine every tail is looked for, but of none that is too long."""
    _listed_as(scene_folder, lambda _: name)
    assert "is not a path; correct it" in refusal(BlenderReader, scene_folder.root)


def test_the_same_spelling_comes_first(scene_folder):
    """r_000.png and R_000.PNG may both be there."""
    iio.imwrite(scene_folder.static / "train/R_000.PNG", np.zeros((24, 32, 4), np.uint8))
    scene = BlenderReader(scene_folder.root).read()
    assert scene.static.train.names[0] == "static/train/r_000.png"


def test_another_format_is_said(scene_folder, caplog):
    caplog.set_level(logging.INFO)
    _listed_as(scene_folder, lambda name: name.replace(".png", ".jpg"))
    BlenderReader(scene_folder.root).read()
    assert "6 images have other suffixes than it lists, r_000.png for r_000.jpg" in caplog.text


def test_letters_composed_in_two_ways(tmp_path, balls):
    """macOS has file names decomposed, lists are mostly composed."""
    root = tmp_path / "scene"
    balls.write(root, [k / 8 for k in range(9)])
    for image in list((root / "images").iterdir()):
        image.rename(image.with_name(unicodedata.normalize("NFD", f"Bü_{image.name}")))

    def rename(content):
        for frame in content["frames"]:
            frame["file_path"] = frame["file_path"].replace("r_", "Bü_r_")
        content["test_filenames"] = [content["frames"][3]["file_path"]]

    balls.edit(root, rename)
    scene = NerfstudioReader(root).read()
    assert (len(scene.dynamic.train), len(scene.dynamic.test)) == (8, 1)


@pytest.mark.parametrize("suffix", [".tif", ".bmp", ".TIFF"])
def test_tiff_and_bmp_are_read(scene_folder, suffix):
    before = BlenderReader(scene_folder.root).read().static.train.pixels[..., :3]
    for file in (scene_folder.static / "train").glob("*.png"):
        image = iio.imread(file)
        file.unlink()
        iio.imwrite(file.with_suffix(suffix), image[..., :3], extension=suffix.lower())
    after = BlenderReader(scene_folder.root).read().static.train.pixels
    assert torch.equal(after[..., :3], before)


def test_formats_that_are_not_read_are_named(llff_folder, refusal):
    images = llff_folder.root / "static/images_4"
    for file in images.iterdir():
        file.rename(file.with_suffix(".HEIC"))
    message = refusal(LlffReader, llff_folder.root)
    assert message.startswith(f"{images}: no images")
    assert ".heic files are there, which are not read: convert them" in message


POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 12345\n"


@pytest.mark.parametrize("file", ["train/r_001.png", "transforms_train.json"])
@pytest.mark.parametrize(
    ("content", "said"),
    [(POINTER, "run git lfs pull"), (b"\n<!DOCTYPE html><html>", "download the file again")],
)
def test_what_stands_in_a_files_place(scene_folder, refusal, file, content, said):
    (scene_folder.static / file).write_bytes(content)
    message = refusal(BlenderReader, scene_folder.root)
    assert message.startswith(str(scene_folder.static / file)) and message.endswith(said)


def test_an_archive_is_to_be_unpacked(tmp_path, refusal):
    (tmp_path / "scene.zip").write_bytes(b"PK")
    assert "is an archive; unpack it" in refusal(BlenderReader, tmp_path / "scene.zip")


def test_images_of_which_nothing_is_seen(scene_folder, refusal):
    for file in (scene_folder.static / "train").iterdir():
        iio.imwrite(file, np.zeros((24, 32, 4), np.uint8))
    message = refusal(BlenderReader, scene_folder.root)
    assert message.startswith(f"{scene_folder.static}/train/r_000.png: its alpha is 0 everywhere")


def test_a_list_of_one_image(tmp_path, balls, refusal):
    root = tmp_path / "scene"
    balls.write(root, [0.0])
    message = refusal(NerfstudioReader, root)
    assert message == f"{root}/transforms.json: lists one image; add more, one of them to hold out"


def test_an_image_that_is_listed_twice(scene_folder, refusal):
    def repeat(content):
        content["frames"] += [{**content["frames"][0], "file_path": "./train/../train/r_000.png"}]

    file = scene_folder.static / "transforms_train.json"
    scene_folder.edit(file, repeat)
    said = "lists './train/../train/r_000.png' twice; list each image once"
    assert refusal(BlenderReader, scene_folder.root) == f"{file}: {said}"


def test_a_matrix_that_is_transposed(scene_folder, refusal):
    def transpose(content):
        for frame in content["frames"]:
            frame["transform_matrix"] = np.transpose(frame["transform_matrix"]).tolist()

    scene_folder.edit(scene_folder.static / "transforms_train.json", transpose)
    message = refusal(BlenderReader, scene_folder.root)
    assert "frames[0].transform_matrix: its last row is " in message
    assert "expected 0, 0, 0, 1; correct it, or transpose" in message
