"""stage=capture from the command line: settings in, one line out where footage is wrong."""

from __future__ import annotations


def test_a_mistake_is_one_line_and_leaves_nothing(devrf, tmp_path, monkeypatch):
    monkeypatch.setattr("devrf.apps.capture.pipeline.check_library", lambda: None)
    outcome = devrf("stage=capture", "capture.static=my walk (1).mp4", "capture.into=scene")
    expected = "devrf: my walk (1).mp4: no such video; correct capture.static or capture.views\n"
    assert (outcome.status, outcome.err) == (2, expected)
    assert not list(tmp_path.iterdir())


def test_a_misspelt_choice_is_answered(devrf):
    outcome = devrf("stage=capture", "capture.matching=sequentil")
    assert outcome.status == 2 and "did you mean capture.matching=sequential?" in outcome.err
