# The public names and the modules that define them; `__init__.py` imports each name at its first use.

from .accuracy.compare import ModelErrors as ModelErrors, compare as compare
from .base.exceptions import (
    ArgumentError as ArgumentError,
    CertificateRefused as CertificateRefused,
    FileFormatError as FileFormatError,
    MissingExtra as MissingExtra,
    NbsPinError as NbsPinError,
    NoSuchFile as NoSuchFile,
    RobotError as RobotError,
    RobotNotFound as RobotNotFound,
    SimulationDiverged as SimulationDiverged,
    TooLarge as TooLarge,
)
from .base.records import Reference as Reference, Run as Run
from .campaigns.campaign import Campaign as Campaign
from .campaigns.table import CampaignTable as CampaignTable, run_campaign as run_campaign
from .certificates.adaptive_bound import TransientBound as TransientBound, transient_bound as transient_bound
from .certificates.admissible import Admissible as Admissible
from .certificates.attack import Attack as Attack, attack as attack
from .certificates.certificate import Certificate as Certificate
from .certificates.certificate_file import write_certificate as write_certificate
from .certificates.certify import certify as certify
from .certificates.encoders import Encoders as Encoders
from .certificates.monitor import Monitored as Monitored, monitor as monitor
from .certificates.online_monitor import Watch as Watch
from .certificates.propose import Proposal as Proposal, propose as propose
from .certificates.reference_margins import certified_margins as certified_margins
from .certificates.transient_attack import TransientAttack as TransientAttack, transient_attack as transient_attack
from .certificates.transient_check import TransientCheck as TransientCheck
from .certificates.uncertainty import Payload as Payload, Uncertainty as Uncertainty
from .controllers.adaptive_law import AdaptiveLaw as AdaptiveLaw
from .controllers.computed_torque import ComputedTorque as ComputedTorque
from .controllers.controller import Controller as Controller, MemorylessController as MemorylessController
from .controllers.damping import Damping as Damping
from .controllers.estimates import Estimate as Estimate
from .controllers.lyapunov_law import LyapunovLaw as LyapunovLaw
from .controllers.model_law import ModelLaw as ModelLaw
from .controllers.neural_backstepping import (
    NeuralBackstepping as NeuralBackstepping,
    paper_controller as paper_controller,
)
from .controllers.pd import PD as PD
from .controllers.pid import PID as PID
from .controllers.potential import Potential as Potential
from .controllers.sliding_mode import SlidingMode as SlidingMode
from .controllers.slotine_li import SlotineLi as SlotineLi
from .dynamics.analytic import AnalyticDynamics as AnalyticDynamics
from .dynamics.coupled import CoupledDynamics as CoupledDynamics
from .dynamics.equations import (
    bias as bias,
    energy as energy,
    forward_dynamics as forward_dynamics,
    inverse_dynamics as inverse_dynamics,
    kinetic_energy as kinetic_energy,
    reference_torque as reference_torque,
)
from .dynamics.friction import DriveFriction as DriveFriction, JointFriction as JointFriction
from .dynamics.identified import IdentifiedDynamics as IdentifiedDynamics
from .dynamics.lagrangian import LagrangianDynamics as LagrangianDynamics
from .dynamics.momentum_observer import (
    ExternalTorque as ExternalTorque,
    MomentumObserver as MomentumObserver,
    ObservedTorques as ObservedTorques,
)
from .dynamics.pinocchio import PinocchioDynamics as PinocchioDynamics
from .dynamics.provider import DynamicsProvider as DynamicsProvider
from .dynamics.residual import ResidualDynamics as ResidualDynamics
from .identification.collect import collect as collect
from .identification.datasets import Dataset as Dataset, load_dataset as load_dataset
from .identification.exciting_motion import ExcitingMotion as ExcitingMotion, exciting_motion as exciting_motion
from .identification.fit import fit as fit
from .identification.identify import identify as identify
from .identification.logs import load_log as load_log
from .identification.measurement import Noise as Noise
from .motions.approach import Approach as Approach
from .motions.disturbances import (
    ConstantTorque as ConstantTorque,
    SinusoidalTorque as SinusoidalTorque,
    SquareWave as SquareWave,
    TorqueNoise as TorqueNoise,
)
from .motions.limits import Margins as Margins
from .motions.reference_files import Sampled as Sampled, load_reference as load_reference
from .motions.references import (
    Hold as Hold,
    MinimumJerk as MinimumJerk,
    Sinusoid as Sinusoid,
    check_reference as check_reference,
    paper_reference as paper_reference,
)
from .motions.tool_files import load_tool_path as load_tool_path
from .motions.tool_motions import ToolMotion as ToolMotion, tool_motion as tool_motion
from .motions.tool_paths import ToolPath as ToolPath
from .motions.tool_postures import tool_posture as tool_posture
from .reports.estimate_charts import plot_estimates as plot_estimates
from .reports.plotting import plot_tracking as plot_tracking
from .reports.replay import replay as replay
from .reports.run_export import export_run as export_run
from .reports.run_import import import_run as import_run
from .robots.catalogue import ROBOT_NAMES as ROBOT_NAMES
from .robots.robot import Robot as Robot, load_robot as load_robot
from .runtime.arms import ArmInterface as ArmInterface, PlantArm as PlantArm
from .runtime.drive import Driven as Driven, drive as drive
from .runtime.franka_arm import FrankaArm as FrankaArm
from .runtime.guard import Fault as Fault, Guard as Guard, Mode as Mode
from .runtime.guarded import FaultReport as FaultReport, Guarded as Guarded, Sample as Sample
from .runtime.ur_arm import URArm as URArm
from .simulation import metrics as metrics
from .simulation.changing_plant import ChangingPlant as ChangingPlant
from .simulation.costs import TimeOutside as TimeOutside, TorqueAware as TorqueAware, squared_error as squared_error
from .simulation.dynamics_plant import DynamicsPlant as DynamicsPlant
from .simulation.mujoco_plant import MujocoPlant as MujocoPlant
from .simulation.plant import Plant as Plant
from .simulation.simulate import simulate as simulate, stream as stream
from .simulation.tool_errors import ToolErrors as ToolErrors, tool_errors as tool_errors
from .storage.checkpoints import about as about, load as load, save as save
from .training.train import Training as Training, train as train
from .verification.verify import Verification as Verification, verify as verify

__version__: str
