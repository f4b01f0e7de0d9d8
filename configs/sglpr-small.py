"""The network `sglpr` without attention, which learns its descriptors: a third of the computation, for the same maps.

Reproduces no result of the paper. The two networks can search each other's descriptor files and maps.

Expect: the numbers of sglpr_jax/weights/sglpr-small/README.md.

Command: bin/train --seq 08 --data IMAGES --preset sglpr-small
"""

from sglpr_jax.methods.recipe import TupleConfig
from sglpr_jax.models.config import model_preset
from sglpr_jax.training.config import LossConfig, OcclusionConfig, OptimizerConfig, TrainConfig

CONFIG = TrainConfig(
    model=model_preset("sglpr-small"),
    sampling=TupleConfig(negatives=0),  # places are drawn as for the triplet loss; the teacher needs no negatives
    loss=LossConfig(teacher="sglpr", ce_weight=0.0, dice_weight=0.0),
    optimizer=OptimizerConfig(learning_rate=1.5e-3, warmup_steps=100, decay_rate=0.5, decay_steps=600, clip_norm=1.0),
    steps=4000,
    tuples=20,
    quarter_turns=0.5,
    occlusion=OcclusionConfig(share=0.1),
    max_points=131072,
    score_every=500,
)
