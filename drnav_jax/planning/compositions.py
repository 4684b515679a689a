"""Planners as one table: what each is composed of. A new planner is a new row.

`headings`, `controls`: the generator's candidates; with neither there is no generator and g* is the goal itself.
`progress`: "cost_to_go" (by way) or "straight" (by air, the paper's). `risk_in_route`: cell cost 1 + lambda P_dead.
`exposure`: lambda * EDE in the score (eq. 7), and as a critic of MPPI. `tracker`: "dwa" drives to g*; "dwb" and "mppi"
follow a `path`: "straight" to the goal, or down the cost-to-go ("route"), made anew every `path_period` [s] (0: at every
replan). `recovery` when stuck: "drnav" (semantic), "nav2" (round robin) or "none".

`dwb` and `mppi` are the paper's rivals, without a global planner; `nav2-dwb` and `nav2-mppi` are how Nav2 is run.
"""

import dataclasses


@dataclasses.dataclass(frozen=True)
class Composition:
    """What a planner is made of (module docstring)."""

    headings: bool = True
    controls: bool = True
    progress: str = "cost_to_go"
    risk_in_route: bool = True
    exposure: bool = True
    recovery: str = "drnav"
    tracker: str = "dwa"
    path: str = "route"
    path_period: float = 0.0

    def __post_init__(self) -> None:
        """Check the combination."""
        if self.progress not in ("cost_to_go", "straight"):
            raise ValueError(f'progress must be "cost_to_go" or "straight", got "{self.progress}".')
        parts = {"recovery": ("drnav", "nav2", "none"), "tracker": ("dwa", "dwb", "mppi"), "path": ("straight", "route")}
        for part, choices in parts.items():
            if getattr(self, part) not in choices:
                raise ValueError(f'{part} must be one of {", ".join(choices)}, got "{getattr(self, part)}".')
        if self.follows and self.path == "route" and self.progress != "cost_to_go":
            raise ValueError('path="route" goes down the cost-to-go: set progress="cost_to_go".')
        if self.path_period < 0:
            raise ValueError(f"path_period must be >= 0 s, got {self.path_period}.")
        if self.controls and not self.headings:
            raise ValueError("controls without headings are not a generator: set headings=True.")

    @property
    def generates(self) -> bool:
        """Whether there is a goal generator at all."""
        return self.headings

    @property
    def predicts(self) -> bool:
        """Whether dead-end evidence matters to it."""
        return self.risk_in_route or self.exposure

    @property
    def follows(self) -> bool:
        """Whether the tracker follows a path."""
        return self.tracker != "dwa"

    @property
    def needs_route(self) -> bool:
        """Whether a cost-to-go is solved for the goal."""
        return self.progress == "cost_to_go" and (self.generates or self.follows)


_REACTIVE = Composition(
    headings=False, controls=False, progress="straight", risk_in_route=False, exposure=False, recovery="none",
    path="straight", path_period=1.0,
)  # fmt: skip
_NAV2 = dataclasses.replace(_REACTIVE, progress="cost_to_go", path="route", recovery="nav2", tracker="dwb")

PLANNERS = {
    "drnav": Composition(),
    "drnav-straight": Composition(progress="straight", risk_in_route=False),
    "drnav-mppi": Composition(tracker="mppi"),
    "dwa": _REACTIVE,
    "dwb": dataclasses.replace(_REACTIVE, tracker="dwb"),
    "mppi": dataclasses.replace(_REACTIVE, tracker="mppi"),
    "nav2-dwb": _NAV2,
    "nav2-mppi": dataclasses.replace(_NAV2, tracker="mppi"),
    "grid": Composition(controls=False, risk_in_route=False, exposure=False),
    "grid+ede": Composition(controls=False, exposure=False),
}


def planner(name: str, recovery: str | None = None) -> Composition:
    """The composition of a named planner.

    Args:
        name: A row of `PLANNERS`.
        recovery: What it does when stuck, instead of its own: "drnav", "nav2" or "none".

    Raises:
        ValueError: If there is no such planner, or no such recovery.
    """
    if name not in PLANNERS:
        raise ValueError(f'There is no planner "{name}": choose from {", ".join(PLANNERS)}.')
    own = PLANNERS[name]
    return own if recovery is None else dataclasses.replace(own, recovery=recovery)
