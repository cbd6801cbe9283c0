"""Every config file composes, fits the parts it names, and builds them."""

from __future__ import annotations

import importlib.util
from itertools import cycle
from pathlib import Path

import pytest
from hydra.core.hydra_config import HydraConfig
from hydra.utils import get_class, instantiate
from omegaconf import OmegaConf

from devrf.apps.fetch import catalogue
from devrf.apps.report.labels import ABLATIONS
from devrf.cli.config import config_folder, group_choices
from devrf.cli.config_check import check_config
from devrf.cli.context import RunContext
from devrf.data.datamodule import SceneDataModule
from devrf.engine.stage import Stage
from devrf.errors import DevrfError
from devrf.methods.devrf.canonical_stage import CanonicalStage
from devrf.methods.devrf.deformation_schedule import DeformationSchedule
from devrf.methods.devrf.deformation_stage import DeformationStage
from devrf.methods.ray_schedule import RaySchedule

NAMES = group_choices()
NEEDS = {
    "logger=tensorboard": "tensorboard",
    "hparams_search=loss_weights": "hydra_plugins.hydra_optuna_sweeper",
}


EMBEDDED = {"procedural", "flower", "procedural_forward"}
FORWARD = {"forward", "neural_3d_video", "pig_toy", "plant", "rabbit", "procedural_forward"}

# Options of these groups go together: a config with one of each.
TOGETHER = ("schedule", "facing", "video", "trainer")
COLUMNS = [cycle([f"{group}={name}" for name in NAMES[group]]) for group in TOGETHER]
ROWS = [" ".join(map(next, COLUMNS)) for _ in range(max(len(NAMES[group]) for group in TOGETHER))]
# Other tests compose these, or a choice in another group does.
OTHERS = ("data", "method", "comparison", "protocol", "profile", "for_scene")
OTHERS += tuple(group for group in NAMES if group.startswith("hydra/"))
ALONE = [group for group in NAMES if group not in (*TOGETHER, *OTHERS)]
ALONE = [f"{group}={name}" for group in ALONE for name in NAMES[group] if name != "default"]


def chain(group, name):
    """The files of ``group`` with values that make up its option ``name``, by its defaults list."""
    file = config_folder() / group / f"{name}.yaml"
    if not file.is_file():  # an option of Hydra's own
        return []
    content = OmegaConf.load(file)
    entries = content.pop("defaults", ())
    bases = [entry.removesuffix("@_here_") for entry in entries if isinstance(entry, str)]
    own = [base for base in bases if "/" not in base and base != "_self_"]
    inherited = [file for base in own for file in chain(group, base)]
    return [name, *inherited] if content else inherited


def test_every_file_sets_or_chooses_something():
    assert not [path for path in config_folder().rglob("*.yaml") if not OmegaConf.load(path)]


@pytest.mark.parametrize("group", NAMES)
def test_an_option_is_read_in_one_file_of_its_group_or_two(group):
    chains = [chain(group, name) for name in NAMES[group]]
    assert not [names for names in chains if len(names) > 2]


def test_cpu_small_is_best_small_for_forward_facing_scenes(composed):
    scene = "data=procedural_forward"
    assert composed(scene, "experiment=cpu_small") == composed(scene, "experiment=best_small")


@pytest.mark.parametrize("profile", [name for name in NAMES["profile"] if "tineuvox" in name])
def test_adams_epsilon_is_far_below_the_slopes_of_a_faint_density(composed, profile):
    """They go with its first opacity; with 1e-4 they are about 1e-8 in dark pictures."""
    stage = composed("method=tineuvox", "protocol=dynamic", f"profile={profile}").ray_stage
    assert stage.schedule.eps <= 1e-5 * stage.model.settings.alpha_init


@pytest.mark.parametrize(("data", "factor"), [("inward", 1), ("colmap", "auto"), ("lego", 2)])
def test_best_takes_images_at_the_size_that_the_scenes_choice_says(composed, data, factor):
    assert composed(f"data={data}", "data.root=x", "experiment=best").data.downscale == factor


@pytest.mark.parametrize(("data", "iterations"), [("inward", 10), ("forward", 50)])
def test_iterations_in_a_step_of_best(composed, data, iterations):
    config = composed(f"data={data}", "data.root=x", "experiment=best")
    steps = (config.canonical.iterations_per_step, config.deformation.iterations_per_step)
    assert steps == (iterations, iterations)


known: set[str] = set()


def is_new(*parts):
    """Whether no config before had just these parts: what was built once need not be again."""
    text = "\n".join(OmegaConf.to_yaml(part, resolve=True) for part in parts)
    before = len(known)
    known.add(text)
    return len(known) > before


@pytest.fixture
def scene(tmp_path) -> Path:
    """A folder in which a layout is recognised."""
    (tmp_path / "scene").mkdir()
    (tmp_path / "scene" / "transforms.json").touch()
    return tmp_path / "scene"


@pytest.mark.parametrize("data", NAMES["data"])
def test_data_composes_builds_its_datamodule_and_chooses_the_facing(composed, scene, data):
    config = composed(f"data={data}", *([] if data in EMBEDDED else [f"data.root={scene}"]))
    check_config(config)
    assert isinstance(instantiate(config.data), SceneDataModule)
    chosen = HydraConfig.get().runtime.choices
    facing = "forward" if data in FORWARD else "inward"
    assert (chosen.facing, chosen.schedule) == (facing, f"quick_{facing}")
    build_stages(config)


def test_the_facing_that_is_typed_goes_before_that_of_the_data(composed):
    composed("data=forward", "facing=inward")
    assert HydraConfig.get().runtime.choices.schedule == "quick_inward"


@pytest.mark.parametrize("choice", [*ROWS, *ALONE])
def test_it_composes_and_builds(composed, scene, choice):
    needed = NEEDS.get(choice)
    if needed and importlib.util.find_spec(needed) is None:
        pytest.skip(f"{needed} is not installed")
    config = composed(*choice.split())
    if OmegaConf.is_missing(config.data, "root"):
        config = composed(*choice.split(), f"data.root={scene}")
    check_config(config)
    build_stages(config)
    if is_new(config.trainer, config.logger, config.callbacks):
        callbacks, loggers = (
            list(instantiate(part).values()) for part in (config.callbacks, config.logger)
        )
        instantiate(config.trainer, logger=loggers, callbacks=callbacks)
    if is_new(config.video):
        assert instantiate(config.video).frames > 0


def build_stages(config):
    """Build the stages of a config, unless one before had just these parts."""
    if "ray_stage" in config:
        stage = instantiate(config.ray_stage, _partial_=True, _convert_="all")
        assert isinstance(stage.keywords["schedule"], RaySchedule)
    elif is_new(config.canonical):
        assert isinstance(instantiate(config.canonical, _convert_="all"), CanonicalStage)
    if "deformation" in config and is_new(config.deformation):
        build = instantiate(config.deformation, _partial_=True, _convert_="all")
        assert build.func is DeformationStage
        assert isinstance(build.keywords["schedule"], DeformationSchedule)


@pytest.mark.parametrize("method", NAMES["method"])
def test_a_method_learns_by_the_protocols_that_it_has_stages_for(composed, tmp_path, method):
    for profile in ("fast", "small"):
        config = composed(f"method={method}", f"profile={method}_{profile}")
        check_config(config)
        if "ray_stage" in config:
            instantiate(config.ray_stage.model.settings, _convert_="all")
            instantiate(config.ray_stage.schedule, _convert_="all")
    for protocol in NAMES["protocol"]:
        config.protocol = OmegaConf.load(config_folder() / f"protocol/{protocol}.yaml")
        run = RunContext(config, tmp_path)
        learns = True
        if "ray_stage" in config:
            known = get_class(config.ray_stage.model._target_).protocols
            learns = known is None or protocol in known
        for step in run.protocol.order:
            if not learns or not {step.name, "ray_stage"} & {*config}:
                with pytest.raises(DevrfError, match=f"method={method} .* protocol={protocol}"):
                    run.plan(step.name)
            elif step.builds_on is None:
                assert isinstance(run.plan(step.name).build(), Stage)


@pytest.mark.parametrize("row", NAMES["comparison"])
def test_a_row_of_the_tables_is_a_method_and_a_protocol_that_it_learns_by(composed, tmp_path, row):
    config = composed(f"comparison={row}", "experiment=peer_small")
    check_config(config)
    run = RunContext(config, tmp_path)
    name = "devrf" if row.startswith("devrf_paper") else row
    assert name.startswith(config.method)
    usual = "two_stage" if name == "devrf" else "joint"
    assert run.protocol.name == (name.removeprefix(config.method).removeprefix("_") or usual)
    run.plan(run.protocol.order[0].name)  # refuses what the method does not learn by


@pytest.mark.parametrize(
    "table", ["comparison_table", "comparison_equal_time", "views_study", "published_table"]
)
def test_a_table_compares_rows_that_there_are(composed, table):
    composed(f"experiment={table}")
    swept = HydraConfig.get().sweeper.params
    assert {*swept.comparison.split(",")} <= {*NAMES["comparison"]}
    if table != "views_study":  # of the paper 12 rows of peers, and DeVRF or its five ablations
        assert len(swept.comparison.split(",")) == {"published_table": 17}.get(table, 22)
    assert {*swept.get("data", "procedural").split(",")} <= {*NAMES["data"]}


@pytest.mark.parametrize("row", ["devrf", "dnerf", "hypernerf_two_stage", "nsff_dynamic"])
def test_rows_of_the_table_compose_for_forward_facing_scenes(composed, row):
    scene = "data=procedural_forward"
    config = composed("experiment=comparison_table", scene, f"comparison={row}")
    check_config(config)
    if row == "devrf":
        usual = composed("experiment=quickstart", scene)
        for group in ("field", "schedule", "sampling", "loss"):
            assert config[group] == usual[group], group


@pytest.mark.parametrize(("facing", "planes"), [("inward", None), ("forward", 128)])
def test_the_settings_of_a_facing(composed, facing, planes):
    paper = composed("comparison=devrf_paper", "data=colmap", "data.root=x", f"facing={facing}")
    usual = composed("data=colmap", "data.root=x", f"facing={facing}")
    assert paper.field.planes == planes
    assert usual.field.planes is None  # as many as the static views resolve
    assert usual.schedule.canonical.crop == (facing == "forward")
    assert usual.loss.fine.tv == paper.loss.fine.tv == (1e-5 if planes else 0)


@pytest.mark.parametrize("page", sorted({scene.collection.page for scene in catalogue()}))
def test_what_to_try_with_a_public_scene_composes(composed, page):
    collection = next(s.collection for s in catalogue() if s.collection.page == page)
    given = (f"data={collection.data}", "data.root=scene")
    check_config(composed(*collection.learn.split(), *given))


def test_building_writes_nothing(composed, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    instantiate(composed("logger=wandb").logger)
    assert not [path for path in Path().rglob("*") if path.is_file()]


@pytest.mark.parametrize(
    ("more", "weight"),
    [((), 100), (("ablation=c2f_tv",), 0), (("ablation=c2f_tv", "loss.deformation.cycle=7"), 7)],
)
def test_the_command_line_overrides_the_ablation_and_that_the_experiment(composed, more, weight):
    assert composed("experiment=quickstart", *more).loss.deformation.cycle == weight


@pytest.mark.parametrize(
    ("overrides", "folder"),
    [
        (["data.shape=flower", "experiment=quickstart"], "outputs/flower/quickstart"),
        (["data=inward", "data.root=/scenes/my scene"], "outputs/my_scene/quickstart"),
        (["data=inward", "data.root=x", "data.name=y"], "outputs/y/quickstart"),
        (["ablation=base", "protocol=joint"], "outputs/robot/quickstart-base-devrf-joint"),
        (["stage=report", "report.into=there"], "there"),
        (["stage=report", "report.runs=no such folder"], "outputs/report"),
        (["outputs=/runs"], "/runs/robot/quickstart"),
        (["outputs=/runs", "stage=report"], "/runs/report"),
    ],
)
def test_where_a_run_lives_is_told_from_scene_experiment_and_ablation(composed, overrides, folder):
    composed(*overrides)
    assert HydraConfig.get().run.dir == folder


@pytest.mark.parametrize("data", ["procedural", "procedural_forward"])
def test_videos_of_the_table_of_ablations_are_alike_for_both_facings(composed, data):
    video = composed("experiment=ablation_table", f"data={data}").video
    assert (video.frames, video.fps, video.max_seconds) == (6, 24, 15)


def test_every_ablation_is_in_a_table(composed):
    tables = []
    for table, scenes in (
        ("ablation_table", ("data.shape", "robot,flower")),
        ("quality_table", ("data.scene_seed", "0,1,2,3,4,5,6,7,8,9")),
        ("quality_table data=procedural_forward", ("data.scene_seed", "0,1,2,3,4,5")),
    ):
        composed(*f"experiment={table}".split())
        hydra = HydraConfig.get()
        assert hydra.mode.name == "MULTIRUN"
        assert scenes in hydra.sweeper.params.items()
        tables.append(hydra.sweeper.params["ablation"].split(","))
    published, inward, forward = tables
    # A report calls them as the paper does, and has rows in their order; gains are over the first.
    assert published == list(ABLATIONS)
    assert inward[:2] == ["cpu_small", "full"] and forward[:2] == ["quick_forward", "full"]
    assert {*published, *inward, *forward} == {*NAMES["ablation"]}
