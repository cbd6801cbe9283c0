"""``experiment=peer_paper`` has each peer's published numbers.

Sources: the papers, and what the released configurations say (docs/methods); of Nerfies and
HyperNeRF those of their validation rig ("vrig"), of D-NeRF and NSFF the releases' (main branch).
"""

from __future__ import annotations

import math

import pytest
from hydra.utils import get_class, instantiate
from omegaconf import OmegaConf

TRUNK = {"width": 256, "depth": 8, "direction_bands": 4}
RIG = TRUNK | {
    "skip": 4, "bands": 8, "initialisation": "glorot",
    "sampling": "hierarchical", "coarse": 128, "fine": 128, "separate_coarse": True,
    "code": 8, "warp_width": 128, "warp_depth": 6, "warp_skip": 4, "warp_bands": 6,
}  # fmt: skip
RIG_SCHEDULE = {
    "iterations": 250_000, "rays": 6144, "learning_rate": 1e-3, "final_learning_rate": 1e-4,
    "betas": [0.9, 0.999], "curriculum": 0.0,
}  # fmt: skip
# Neural Volumes' colours have a deviation of 25 of 255: their squared errors are 104 times ours.
UNIT = (255 / 25) ** 2
PUBLISHED = {
    "dnerf": {
        "settings": TRUNK | {
            "skip": 5, "bands": 10, "initialisation": "uniform",
            "deformation_width": 256, "deformation_depth": 8, "time_bands": 10,
            "sampling": "hierarchical", "coarse": 64, "fine": 128, "separate_coarse": False,
        },
        "schedule": {
            "iterations": 800_000, "rays": 500, "learning_rate": 5e-4, "centre_crop": 500,
            "final_learning_rate": pytest.approx(5e-4 * 0.1 ** (8 / 5), rel=1e-3),
            "betas": [0.9, 0.999], "curriculum": 100 / 800,
        },
        "loss": {"render": 1.0, "temporal": 0.0},
    },
    "nerfies": {
        "settings": RIG, "schedule": RIG_SCHEDULE, "loss": {"render": 1.0, "elastic": 1e-3},
    },
    "hypernerf": {
        "settings": RIG | {
            "slicing": "surface", "ambient": 2, "ambient_bands": 1,
            "slicing_width": 64, "slicing_depth": 6, "slicing_skip": 4, "slicing_bands": 6,
        },
        "schedule": RIG_SCHEDULE,
        "loss": {"render": 1.0, "elastic": 0.0},
    },
    "nsff": {
        "settings": TRUNK | {
            "skip": 5, "bands": 10, "samples": 128, "density_noise": 1.0, "neighbours": "both",
            "hard_rays": 512, "blend": "v", "sampling": "stratified",
        },
        "warmup": {
            "steps_per_frame": 1000, "max_frames": 250, "chained_from": 2, "prior_decay": 10,
        },
        # The rate falls tenfold in 300 000 iterations.
        "schedule": {
            "iterations": 360_000, "rays": 1024, "learning_rate": 5e-4,
            "final_learning_rate": pytest.approx(5e-4 * 0.1**1.2, rel=1e-3), "betas": [0.9, 0.999],
        },
        "loss": {
            "render": 1, "dynamic": 1, "neighbours": 1, "chained": 1, "cycle": 1.0,
            "small_flow": pytest.approx(0.1 / 128, rel=2e-3), "smooth_space": 0.1,
            "smooth_time": 0.1, "depth": 0.04, "flow": 0.02, "disocclusion": 0.1,
            "blend_entropy": 1e-3,
        },
    },
    "tineuvox": {
        "settings": {
            "side": 160, "channels": 6, "width": 256, "alpha_init": 1e-3, "strides": [1, 2, 4],
            "upsample_at": [0.1, 0.2, 0.3], "step": 0.5, "weight_threshold": 1e-4, "tv": 0.0,
            "bands": 10, "direction_bands": 4, "time_bands": 8, "feature_bands": 2,
            "grid_rate": 0.08 / 8e-4, "deformation_rate": pytest.approx(6e-4 / 8e-4),
        },
        "schedule": {
            "iterations": 20_000, "rays": 4096, "learning_rate": 8e-4,
            "final_learning_rate": 8e-5, "betas": [0.9, 0.99],
        },
        "loss": {"render": 1.0, "background_entropy": 0.001, "sample_color": 0.01},
    },
    "kplanes": {
        "settings": {
            "resolution": 64, "scales": [1, 2, 4, 8], "channels": 32, "width": 64,
            "basis_width": 128, "basis_depth": 4, "samples": 48, "proposal_samples": [256, 128],
            "proposal_resolutions": [64, 128], "proposal_channels": 8,
            "annealing": 1000, "teaching": 5000,
        },
        "schedule": {
            "iterations": 30_001, "rays": 4096, "learning_rate": 0.01, "final_learning_rate": 0,
            "decay": "cosine", "warmup": pytest.approx(512 / 30_001, rel=5e-3), "eps": 1e-15,
        },
        "loss": {
            "render": 1, "tv": 1e-4, "smooth": 0.01, "smooth_proposals": 0.001, "change": 1e-4,
            "histogram": 1, "distortion": 0,
        },
    },
    "gaussians": {
        "settings": {
            "width": 256, "depth": 8, "bands": 10, "time_bands": 10, "still": 3000 / 40_000,
            "harmonics": 3, "harmonics_every": 1000 / 40_000, "densify_from": 500 / 40_000,
            "densify_until": 15_000 / 40_000, "densify_every": 100 / 40_000,
            "densify_above": 2e-4, "prune_below": 0.005, "reset_every": 3000 / 40_000,
            "means_rate": pytest.approx(1.6e-4 / 8e-4), "scales_rate": 1e-3 / 8e-4,
            "quaternions_rate": 1e-3 / 8e-4, "opacity_rate": pytest.approx(0.05 / 8e-4),
            "color_rate": 2.5e-3 / 8e-4, "harmonics_rate": 2.5e-3 / 8e-4 / 20,
            # A hundredth, while the network's rate falls to 1.6e-6 / 8e-4.
            "means_decay": pytest.approx(math.log(100) / math.log(500), rel=1e-3),
        },
        "schedule": {
            "iterations": 40_000, "learning_rate": 8e-4, "final_learning_rate": 1.6e-6,
            "eps": 1e-15,
        },
        "loss": {"l1": 0.8, "ssim": 0.2},
    },
    "neural_volumes": {
        # Images of 512 x 334 pixels in 512 x 384; seven convolutions.
        "settings": {
            "code": 256, "encoder_views": 3, "encoder_width": 512, "encoder_size": [512, 384],
            "encoder_channels": [64, 64, 128, 128, 256, 256, 256],
            "template_channels": [1024, 512, 512, 256, 256, 128, 128],
            "warp": "affinemix", "warp_side": 32, "maps": 16, "identity_start": False,
            "warp_channels": [1024, 512, 512, 256, 256], "warp_scale": 2 / 1024,
            "step": 4 / 256, "hull": False,
        },
        "schedule": {
            "iterations": 500_000, "rays": 16 * 128**2, "times_per_batch": 16,
            "learning_rate": 1e-4, "final_learning_rate": 1e-4, "betas": [0.9, 0.999],
        },
        "loss": {
            "render": 1,
            "kl": pytest.approx(0.001 / UNIT, rel=2e-3),
            "opacity_prior": pytest.approx(0.01 / UNIT, rel=2e-3),
            "tv": pytest.approx(0.01 / UNIT, rel=2e-3),
        },
    },
}  # fmt: skip


@pytest.mark.parametrize("method", PUBLISHED)
def test_the_published_numbers_are_the_config_and_the_defaults_of_the_code(composed, method):
    config = composed(f"method={method}", "experiment=peer_paper", "protocol=joint").ray_stage
    stage = OmegaConf.to_container(config)
    settings = stage["model"]["settings"]
    parts = {**stage, "settings": settings, "warmup": settings.get("warmup")}
    for part, numbers in PUBLISHED[method].items():
        assert {name: parts[part][name] for name in numbers} == numbers, part
    built = instantiate(config.model.settings, _convert_="all")
    for name, default in vars(type(built)()).items():
        given = getattr(built, name)
        assert (tuple(given) if isinstance(given, list) else given) == default, name
    assert set(config.loss) == set(get_class(config.model._target_).losses)


# What a published form has that the method's file has not.
FORMS = {
    "tineuvox_light": {
        "settings": {"side": 100, "channels": 4, "width": 64, "alpha_init": 1e-2},
    },
    "tineuvox_phone": {
        "settings": {
            "upsample_at": [0.1, 0.2, 0.3, 0.4], "grid_rate": 0.1 / 1e-3,
            "deformation_rate": pytest.approx(7e-4 / 1e-3),
            "tv": pytest.approx(1e-5 / 4096, rel=1e-2),
        },
        "schedule": {"learning_rate": 1e-3, "final_learning_rate": 1e-4},
    },
    "kplanes_paper": {"settings": {"sampling": "proposals", "decoder": "hybrid"}},
    "kplanes_explicit": {"settings": {"sampling": "proposals", "decoder": "explicit"}},
    "kplanes_video": {
        "settings": {
            "sampling": "proposals", "decoder": "hybrid", "time_resolution": 150, "channels": 16,
            "proposal_resolutions": [128, 256],
        },
        "schedule": {"iterations": 90_001, "warmup": pytest.approx(512 / 90_001, rel=5e-3)},
        "loss": {"tv": 2e-4, "smooth": 1e-3, "smooth_proposals": 1e-5, "distortion": 1e-3},
    },
    "kplanes_video_explicit": {
        "settings": {
            "sampling": "proposals", "decoder": "explicit", "time_resolution": 150,
            "channels": 32, "basis_depth": 1, "proposal_resolutions": [128, 256],
        },
        "schedule": {"iterations": 120_001, "warmup": pytest.approx(512 / 120_001, rel=5e-3)},
        "loss": {"tv": 1e-4, "smooth": 1e-3, "smooth_proposals": 1e-5, "distortion": 1e-3},
    },
}  # fmt: skip


@pytest.mark.parametrize("profile", FORMS)
def test_a_profile_has_the_published_numbers_of_its_form(composed, profile):
    method = profile.split("_")[0]
    config = composed(f"method={method}", f"profile={profile}").ray_stage
    stage = OmegaConf.to_container(config)
    parts = {**stage, "settings": stage["model"]["settings"]}
    for part, numbers in FORMS[profile].items():
        assert {name: parts[part][name] for name in numbers} == numbers, part
    instantiate(config.model.settings, _convert_="all")


@pytest.mark.parametrize("method", ["nerfies", "hypernerf"])
def test_windows_open_at_the_published_iterations(composed, method):
    config = composed(f"method={method}", "experiment=peer_paper", "protocol=joint")
    model = instantiate(config.ray_stage.model, settings={"width": 8, "warp_width": 8})
    opened = {}
    for step in (0, 1_000, 6_000, 11_000, 40_000, 80_000, 249_999):
        model.on_iteration(step, config.ray_stage.schedule.iterations)
        ambient = round(model.opened.item(), 4) if method == "hypernerf" else None
        opened[step] = round(model.warp.opened.item(), 4), ambient
    alpha = [0.0, 0.075, 0.45, 0.825, 3.0, 6.0, 6.0]
    assert [of_warp for of_warp, _ in opened.values()] == alpha
    if method == "hypernerf":
        assert [w for _, w in opened.values()] == [0.0, 0.0, 0.5, 1.0, 1.0, 1.0, 1.0]
