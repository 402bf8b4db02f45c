"""Public names of `gbid.rig`, and the files that define them: the one list."""

from .effects import (
    rig_effect as rig_effect,
    rig_effects as rig_effects,
)
from .excitation import (
    Course as Course,
    Hammer as Hammer,
    Impact as Impact,
    Played as Played,
    Prbs as Prbs,
    RunUp as RunUp,
    ScheduledRun as ScheduledRun,
    StackStaircase as StackStaircase,
    Staircase as Staircase,
    Stationary as Stationary,
)
from .film import (
    FilmPoint as FilmPoint,
    GasFilm as GasFilm,
)
from .machine import (
    ActuatorTruth as ActuatorTruth,
    Contact as Contact,
    FilmStiffening as FilmStiffening,
    FlexibleMode as FlexibleMode,
    Machine as Machine,
    NonSynchronous as NonSynchronous,
    ProcessNoise as ProcessNoise,
    RigEffect as RigEffect,
    RigRun as RigRun,
    RotorBearingTruth as RotorBearingTruth,
    Scatter as Scatter,
    Unbalance as Unbalance,
    scatter_random as scatter_random,
    scattered as scattered,
)
from .piezo import (
    PiezoStack as PiezoStack,
    PiezoStacks as PiezoStacks,
)
from .simulation import (
    Experiment as Experiment,
    Faults as Faults,
    drawn_truth as drawn_truth,
    record as record,
    saturations as saturations,
    touch_downs as touch_downs,
)
from .response import (
    Motion as Motion,
    driven_motion as driven_motion,
    possible_machines as possible_machines,
    unbalance_orbit as unbalance_orbit,
)
from .sensors import (
    LoopProgram as LoopProgram,
    ProgramController as ProgramController,
    SampledController as SampledController,
    SensorChain as SensorChain,
)
from .stepping import (
    SteppedMotion as SteppedMotion,
    stepped_motion as stepped_motion,
)
