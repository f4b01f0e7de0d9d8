"""Where only walls are seen, the sensor is assumed to move on as before, and its motion drifts."""

import numpy as np
import pytest
from scenes import seen_from

import sglpr_jax
from sglpr_jax.grid import Grid
from sglpr_jax.loops.candidates import CandidateFinder
from sglpr_jax.loops.config import DetectorConfig
from sglpr_jax.loops.keyframes import Seen

GRID = Grid(resolution_m=0.4, height=152, width=152)
POSTS_UNTIL_M, REACH_M, FRAMES = 10.0, 25.0, 60
RNG = np.random.default_rng(0)
WALLS = np.stack([RNG.uniform(-60, 120, 40_000), np.sign(RNG.uniform(-1, 1, 40_000)) * 6.0], axis=1)
POSTS = np.repeat(RNG.uniform((-60, -5), (POSTS_UNTIL_M, 5), (60, 2)), 20, axis=0)


@pytest.mark.parametrize("step_m", [0.7, 1.0])
def test_between_plain_walls_the_sensor_moves_on_and_drifts(step_m):
    finder = CandidateFinder(sglpr_jax.load("circular"), DetectorConfig(keyframe_m=0.0))
    descriptor, world = np.zeros(finder.index.width, np.float32), np.concatenate([WALLS, POSTS])
    for frame in range(FRAMES):
        image = seen_from(world, (step_m * frame, 0.0, 0.0), grid=GRID, seed=frame)
        finder.add_seen(Seen(descriptor, image.astype(np.uint8), None), time=0.1 * frame)
    motion, alone = finder.motion, int((POSTS_UNTIL_M + REACH_M) / step_m)  # frame from which no post is in reach
    begun, seen = 10, alone - int(15 / step_m)
    assert motion.guessed_m[begun] == motion.guessed_m[seen] < motion.guessed_m[-1]
    moved = motion.poses[-1] - motion.poses[begun]
    assert moved[0, 3] == pytest.approx(step_m * (FRAMES - 1 - begun), rel=0.1)
    assert motion.segments[begun] == motion.segments[-1]
