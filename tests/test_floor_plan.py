"""The plan of the house holds: imports point down, files import each other in no circle, linen stays in the models."""

import ast
import functools
from graphlib import TopologicalSorter
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[1] / "sglpr_jax"
GROUND = "bev categories extras fields files frame_log grid growing labels losses metrics numpy_files progress revisits"
FLOORS = (
    (*GROUND.split(), "same_place", "schema", "se3", "stop_request", "voxels"),
    ("data",),
    ("models", "sim"),
    ("methods",),
    ("registration", "retrieval", "training"),
    ("odometry",),
    ("loops",),
    ("pose_graph",),
    ("maps",),
    ("evaluation", "live"),
    ("reproduce",),
    ("cli",),
)
"""From the ground up. Only the files of the ground import others on their own floor."""
MOST_FILES_IN_A_CHAIN = 14
FLOOR = {room: number for number, rooms in enumerate(FLOORS) for room in rooms}
FILES = {
    ".".join(("sglpr_jax", *path.relative_to(PACKAGE).with_suffix("").parts)).removesuffix(".__init__"): path
    for path in sorted(PACKAGE.rglob("*.py"))
    if "configs" not in path.parts
}


@functools.cache
def imported(path: Path, *, when_loaded: bool = False) -> tuple[str, ...]:
    """The modules that a file imports, perhaps only those when it is loaded, not in its functions.

    Of `from a import b`, this is the file b of the package a where there is one.
    """
    found, tree = [], ast.parse(path.read_text())
    for node in tree.body if when_loaded else ast.walk(tree):
        if isinstance(node, ast.Import):
            found += [name.name for name in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            inner = [f"{node.module}.{name.name}" for name in node.names]
            found += [name if name in FILES else node.module for name in inner]
    return tuple(found)


def room(module: str) -> str:
    """The folder, or the file on the ground floor, that a module is in."""
    return module.split(".")[1]


def test_imports_point_down():
    for module in FILES.keys() - {"sglpr_jax"}:
        for other in imported(FILES[module]):
            assert other != "sglpr_jax", f"{module} imports the table of contents"
            if other.startswith("sglpr_jax.") and room(other) != room(module):
                assert FLOOR[room(other)] < FLOOR[room(module)] or FLOOR[room(other)] == 0, f"{module} imports {other}"


def test_every_room_has_a_floor():
    assert {room(module) for module in FILES if module != "sglpr_jax"} == set(FLOOR)


def test_no_two_files_import_each_other():
    graph = {module: {other for other in imported(path) if other in FILES} for module, path in FILES.items()}
    TopologicalSorter(graph).prepare()  # raises CycleError, which names the circle


def test_chains_of_imports_are_short():
    @functools.cache
    def chain(module: str) -> tuple[str, ...]:
        below = (chain(other) for other in imported(FILES[module], when_loaded=True) if other in FILES)
        return (module, *max(below, key=len, default=()))

    longest = max((chain(module) for module in FILES), key=len)
    assert len(longest) <= MOST_FILES_IN_A_CHAIN, " -> ".join(longest)


def test_flax_modules_are_in_the_models_and_learned_methods_alone():
    for module, path in FILES.items():
        if "flax.linen" in set(imported(path)):
            assert module.startswith(("sglpr_jax.models.", "sglpr_jax.methods.learned.")), module
