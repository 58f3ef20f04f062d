"""What a table may hold, and what the user says of it."""

from __future__ import annotations

from dataclasses import dataclass, field

from pincal.errors import MeasurementError
from pincal.measure.fields import Field
from pincal.measure.options import TableOptions
from pincal.robot.tree import Mimic

# Where the joints stood as well, and by what factor that minus the fitted positions is commanded minus read back.
OTHERS = {"commanded": 1.0, "read": -1.0}


@dataclass(frozen=True)
class Schema:
    """What a table may hold.

    Attributes:
        fields: the quantities that are understood.
        joint_names: the joints, each with a column of its own and perhaps one for the direction of approach and for the
            position commanded or read back beside it.
        joint_types: "revolute" or "prismatic" for each joint, which says the units it may have; all revolute if empty.
        mimics: the joints that follow another one; they may be absent, as their position follows from that one's.
        may_lack_joints: whether a table without any joint is allowed.
        options: what the user says of it.
    """

    fields: tuple[Field, ...]
    joint_names: tuple[str, ...] = ()
    joint_types: tuple[str, ...] = ()
    mimics: tuple[Mimic, ...] = ()
    may_lack_joints: bool = False
    options: TableOptions = field(default_factory=TableOptions)

    @property
    def own_joints(self) -> tuple[str, ...]:
        """The joints that follow none, whose columns are needed."""
        driven = {mimic.joint for mimic in self.mimics}
        return tuple(name for name in self.joint_names if name not in driven)

    def quantities(self, *, source: str) -> dict[str, str]:
        """Return the physical quantity of every column that a table may have; joints that clash with a field are refused."""
        known = {column: field.quantity for field in self.fields for column in field.columns}
        clash = [name for name in self.joint_names if name in known]
        if clash:
            raise MeasurementError(f'{source}: joint "{clash[0]}" has the name of a column; rename it in the URDF')
        types = self.joint_types or ("revolute",) * len(self.joint_names)
        pairs = zip(self.joint_names, types, strict=True)
        joints = {name: "length" if kind == "prismatic" else "angle" for name, kind in pairs}
        # Beside the positions that are fitted, the other ones: those commanded where they were read back, or the reverse.
        others = {f"{kind}_{name}": quantity for kind in OTHERS for name, quantity in joints.items()}
        return joints | known | {f"approach_{name}": "number" for name in self.joint_names} | others
