"""A folder with a published scene's name and layout: experiment=paper says what data=NAME sets."""

from __future__ import annotations

import shutil

SET = "lego: one of DeVRF's scenes; data=lego would set "


def test_what_the_scenes_own_choice_sets(devrf, tmp_path, tiny_data, short):
    assert devrf(*tiny_data, "stage=prepare", "data.export=lego").status == 0
    hull = ("schedule.canonical.visual_hull_init=true", "schedule.canonical.search_iterations=0")
    at_rest = [word for word in short if not word.startswith("schedule.deformation")]
    learn = (*at_rest, *hull, "stage=canonical", "data.root=lego", "resume=false")

    def said(*typed: str) -> list[str]:
        outcome = devrf(*learn, *typed)
        assert outcome.status == 0, outcome.err
        return [line.removeprefix(SET) for line in outcome.out.splitlines() if "DeVRF's" in line]

    assert said("experiment=paper") == ["data.bound_scale=1.2, data.downscale=2, data.space=world"]
    typed = ("experiment=paper", "data=inward", "data.downscale=2")
    assert said(*typed) == ["data.bound_scale=1.2, data.space=world"]
    assert said("experiment=paper", "data=lego") == said() == []
    # NeRF-synthetic has a scene of that name, too.
    (tmp_path / "lego").rename(tmp_path / "devrf")
    shutil.copytree(tmp_path / "devrf" / "static", tmp_path / "lego")
    assert said("experiment=paper") == []
