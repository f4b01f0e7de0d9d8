"""Public API: the module of each name. Read by type checkers, and by `lazy_loader` when a name is first used."""

from .bev import (
    count_outside as count_outside,
)
from .bev import (
    rasterize as rasterize,
)
from .bev import (
    rasterize_labels as rasterize_labels,
)
from .bev import (
    rotate_image as rotate_image,
)
from .bev import (
    rotate_points as rotate_points,
)
from .data import (
    Record as Record,
)
from .data import (
    Recording as Recording,
)
from .data import (
    open_recording as open_recording,
)
from .data import (
    read_scan as read_scan,
)
from .data import (
    recording_names as recording_names,
)
from .data.density_image import density_bev as density_bev
from .data.deskew import deskew as deskew
from .data.deskew import deskewed as deskewed
from .data.gravity import GroundFilter as GroundFilter
from .data.mounting import Mounting as Mounting
from .data.mounting import estimate_mounting as estimate_mounting
from .data.scaled import scaled as scaled
from .data.submap import SubmapBuilder as SubmapBuilder
from .data.submap import submaps as submaps
from .evaluation.scoring import Evaluation as Evaluation
from .evaluation.scoring import evaluate as evaluate
from .grid import Grid as Grid
from .labels import CATEGORIES as CATEGORIES
from .labels import taxonomy as taxonomy
from .labels import to_classes as to_classes
from .loops.detector import LoopDetector as LoopDetector
from .loops.find import find_loops as find_loops
from .loops.find_between import find_loops_between as find_loops_between
from .loops.incremental import IncrementalTrajectory as IncrementalTrajectory
from .loops.loop import Loop as Loop
from .loops.odometry import read_odometry as read_odometry
from .loops.optimization import optimize_trajectory as optimize_trajectory
from .loops.places import PlaceMap as PlaceMap
from .loops.scan_odometry import scan_odometry as scan_odometry
from .loops.slam import slam as slam
from .models.average import average as average
from .models.backbones.circular_config import CircularConfig as CircularConfig
from .models.backbones.sglpr_config import SglprConfig as SglprConfig
from .models.backbones.swin_config import SwinConfig as SwinConfig
from .models.config import HeadConfig as HeadConfig
from .models.config import ModelConfig as ModelConfig
from .models.params import Params as Params
from .models.presets import MODELS as MODELS
from .models.presets import model_preset as model_preset
from .models.program import save_program as save_program
from .models.sglpr import (
    Outputs as Outputs,
)
from .models.sglpr import (
    describe as describe,
)
from .models.sglpr import (
    forward as forward,
)
from .models.sglpr import (
    init as init,
)
from .models.sglpr import (
    is_describable as is_describable,
)
from .models.sglpr import (
    segment as segment,
)
from .models.shipped import shipped_weights as shipped_weights
from .models.weights import for_places as for_places
from .models.weights_file import load as load
from .models.weights_file import save as save
from .retrieval.descriptor_file import DescriptorFile as DescriptorFile
from .retrieval.embed import embed as embed
from .retrieval.embed import scan_image as scan_image
from .retrieval.fleet_index import FleetIndex as FleetIndex
from .retrieval.index import Index as Index
from .retrieval.nearest import Nearest as Nearest
from .retrieval.nearest import nearest as nearest
from .sim.simulation import simulate as simulate
from .training.presets import preset as preset
from .training.recipe import TrainResult as TrainResult
from .training.recipe import train as train

__version__: str
