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
    RotorBearingTruth as RotorBearingTruth,
    Scatter as Scatter,
    Unbalance as Unbalance,
)
from .piezo import (
    PiezoStack as PiezoStack,
    PiezoStacks as PiezoStacks,
)
from .simulation import (
    Faults as Faults,
    record as record,
    saturations as saturations,
    touch_downs as touch_downs,
)
from .response import (
    possible_machines as possible_machines,
)
from .sensors import (
    ProgramController as ProgramController,
    SampledController as SampledController,
    SensorChain as SensorChain,
)
