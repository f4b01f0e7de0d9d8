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
from .data.density_image import density_bev as density_bev
from .data.deskew import deskew as deskew
from .data.deskew import deskewed as deskewed
from .data.formats.scan_files import read_scan as read_scan
from .data.gravity import GroundFilter as GroundFilter
from .data.mounting import Mounting as Mounting
from .data.mounting import estimate_mounting as estimate_mounting
from .data.readers import open_recording as open_recording
from .data.readers import recording_names as recording_names
from .data.recording import Recording as Recording
from .data.scaled import scaled as scaled
from .data.scan import Scan as Scan
from .data.submap import SubmapBuilder as SubmapBuilder
from .data.submap import submaps as submaps
from .evaluation.scoring import Evaluation as Evaluation
from .evaluation.scoring import evaluate as evaluate
from .grid import Grid as Grid
from .labels import CATEGORIES as CATEGORIES
from .labels import taxonomy as taxonomy
from .labels import to_classes as to_classes
from .loops.closure import LoopClosure as LoopClosure
from .loops.detector import LoopDetector as LoopDetector
from .loops.search import find_loops as find_loops
from .maps.build import map_recording as map_recording
from .maps.place_map import PlaceMap as PlaceMap
from .models.backbone_config import CircularConfig as CircularConfig
from .models.backbone_config import SglprConfig as SglprConfig
from .models.backbone_config import SwinConfig as SwinConfig
from .models.config import MODELS as MODELS
from .models.config import HeadConfig as HeadConfig
from .models.config import ModelConfig as ModelConfig
from .models.config import model_preset as model_preset
from .models.export import save_program as save_program
from .models.params import Params as Params
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
from .models.weights import average as average
from .models.weights import for_places as for_places
from .models.weights_file import load as load
from .models.weights_file import save as save
from .odometry.kiss_icp import scan_odometry as scan_odometry
from .pose_graph.incremental import IncrementalTrajectory as IncrementalTrajectory
from .pose_graph.odometry_files import read_odometry as read_odometry
from .pose_graph.optimize import optimize_trajectory as optimize_trajectory
from .pose_graph.slam import slam as slam
from .retrieval.descriptor_file import DescriptorFile as DescriptorFile
from .retrieval.embed import embed as embed
from .retrieval.embed import scan_image as scan_image
from .retrieval.fleet_index import FleetIndex as FleetIndex
from .retrieval.index import Index as Index
from .sim.dataset import simulate as simulate
from .sim.drive import CARRIERS as CARRIERS
from .sim.recording import simulate_recording as simulate_recording
from .sim.recording import simulate_repeating as simulate_repeating
from .sim.sensor import SENSORS as SENSORS
from .training.presets import preset as preset
from .training.recipe import TrainResult as TrainResult
from .training.recipe import train as train

__version__: str
