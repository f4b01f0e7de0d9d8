"""The fields of a preset's own backbone are flags of bin/train and bin/reproduce; those of another are refused."""

import pytest

from sglpr_jax.cli import reproduce, train
from sglpr_jax.models.backbone_config import CircularConfig, SwinConfig


@pytest.mark.parametrize(
    "parse", [train.parse, lambda flags: reproduce.parse(["table1", *flags])], ids=["train", "reproduce"]
)
def test_a_flag_reaches_the_backbone_of_the_preset(parse):
    swin = parse(["--preset", "paper", "--model.backbone.window", "2", "--model.head.cbam", "False"]).config.model
    assert isinstance(swin.backbone, SwinConfig) and swin.backbone.window == 2
    assert swin.backbone.patch == 4 and not swin.head.cbam
    rings = parse(["--preset", "circular", "--model.backbone.means", "1", "1", "2", "1", "1", "1", "1"]).config.model
    assert isinstance(rings.backbone, CircularConfig) and rings.backbone.means == (1, 1, 2, 1, 1, 1, 1)
    sglpr = parse(["--preset", "sglpr", "--model.backbone.stem.average", "1"]).config.model
    assert sglpr.backbone.stem.average == 1


def test_the_flags_of_another_backbone_are_unknown():
    with pytest.raises(ValueError, match=r"found '--model\.backbone\.window'"):
        train.parse(["--preset", "circular", "--model.backbone.window", "4"])
