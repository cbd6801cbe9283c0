"""Plots show what was measured, and only that."""

from __future__ import annotations

from devrf.apps.report.plots import (
    against_budget,
    against_views,
    plots,
    psnr_against_seconds,
    psnr_over_time,
)


def curves(axes):
    """The points of each labelled curve."""
    return {
        line.get_label(): list(zip(line.get_xdata(), line.get_ydata(), strict=True))
        for line in axes.get_lines()
    }


def test_psnr_over_time_is_the_mean_over_seeds(table, ran):
    ran("a", seed=0, curve=[(0.0, 30.0), (1.0, 20.0)])
    ran("b", seed=1, curve=[(0.0, 32.0), (1.0, 22.0)])
    ran("c", ablation="base", curve=[(0.0, 15.0), (1.0, 14.0)])
    ran("d", "flower", curve=[(0.0, 1.0)])
    (axes,) = psnr_over_time(table(), "robot").axes
    assert curves(axes) == {
        "Ours (base)": [(0, 15), (1, 14)],
        "Ours w/ c2f, tv, cycle, flow": [(0, 31), (1, 21)],
    }
    assert axes.get_title() == "robot"


def test_psnr_against_seconds_has_a_panel_a_scene_and_the_published_rows(table, ran):
    ran("a", "lego", scores={"psnr": 30.0}, seconds=(100, 200))
    ran("b", "robot", scores={"psnr": 25.0}, seconds=(10, 20))
    ran("c", "flower", seconds=(None, 20))
    lego, robot = psnr_against_seconds(table()).axes
    assert [axes.get_title() for axes in (lego, robot)] == ["lego", "robot"]
    assert curves(robot) == {"Ours w/ c2f, tv, cycle, flow": [(30, 25)]}
    points = [(x, y) for line in lego.get_lines() for x, y in zip(*line.get_data(), strict=True)]
    assert len(points) == 1 + 17
    assert points[0] == (300, 30) and (540, 29.25) in points


def test_metrics_against_views_need_several_numbers_of_them(table, ran):
    def ran_with(views, psnr, ssim):
        typed = {
            "settings": {"data.train_views": views},
            "overrides": [f"data.train_views={views}"],
        }
        ran(str(views), train_views=views, scores={"psnr": psnr, "ssim": ssim}, **typed)

    ran_with(1, 20.0, 0.8)
    ran("base", ablation="base", train_views=1)
    assert against_views(table()) is None
    ran_with(3, 26.0, 0.9)
    figure = against_views(table())
    points = [axes.get_lines()[0].get_xydata().tolist() for axes in figure.axes]
    assert points == [[[1, 20], [3, 26]], [[1, 0.8], [3, 0.9]]]
    assert figure.axes[0].get_legend_handles_labels()[1] == ["robot"]


def test_budgets_have_tables_of_their_own_and_a_plot_with_means_and_spread(table, ran):
    for budget, seed, psnr in ((15, 0, 20.0), (15, 1, 22.0), (60, 0, 30.0), (60, 1, 30.0)):
        for priors, gain in (({}, 1.0), ({"priors": "none"}, 0.0)):
            settings = {"schedule.seconds": budget, **priors}
            scores = {"psnr": psnr + gain, "ssim": 0.9}
            ran(f"{budget}{seed}{gain}", settings=settings, seed=seed, scores=scores)
    made = table()
    blocks = {b.title: [cell.text for cell in b.cells["PSNR ↑"]] for b in made.blocks}
    assert len(blocks) == 4 and blocks["robot, 60 s"] == ["31.00 ± 0.00"]
    assert blocks["robot, without priors, 15 s"] == ["21.00 ± 1.41"]
    psnr, _ = against_budget(made, "robot, without priors").axes
    assert [c.get_ydata().tolist() for c in psnr.get_lines()[:1]] == [[21.0, 30.0]]
    assert psnr.get_xticks().tolist() == [15, 60]
    ends = {plot.name.removeprefix("quality_against_seconds_robot") for plot in plots(made)}
    assert ends == {"", "_without_priors"}


def test_no_plot_of_what_is_not_there(table, ran):
    ran("a", seconds=(None, None))
    assert plots(table()) == []
    ran("b", "a scene/of mine", curve=[(0.0, 20.0)], seconds=(1, 2))
    assert [plot.name for plot in plots(table())] == [
        "psnr_against_seconds",
        "psnr_over_time_a_scene_of_mine",
    ]


def test_a_legend_covers_no_curve_and_is_not_cut_off(table, ran):
    name = "a method with a name that is longer than a plot is wide: "
    for k in range(9):
        ran(f"{k}", method=f"{name}{k}" * 2, protocol="two_stage", curve=[(0.0, 20.0 + k)])
    figure = plots(table())[-1].figure
    figure.draw_without_rendering()
    legend, (axes,) = figure.legends[0].get_window_extent(), figure.axes
    assert legend.y1 <= axes.get_tightbbox().y0 and legend.y0 >= 0
    assert legend.x0 >= -1 and legend.x1 <= figure.bbox.width + 1
    assert axes.bbox.height / figure.dpi > 2.5
