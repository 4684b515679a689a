"""Planners as one table: what each is composed of. A new planner is a new row.

`headings`, `controls`: the generator's candidates; with neither there is no generator and g* is the goal itself.
`progress`: "cost_to_go" (by way) or "straight" (by air, the paper's). `risk_in_route`: cell cost 1 + lambda P_dead.
`exposure`: lambda * EDE in the score (eq. 7). `recovery`: semantic recovery when stuck. All are tracked by the same DWA.
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
    recovery: bool = True

    def __post_init__(self) -> None:
        """Check the combination."""
        if self.progress not in ("cost_to_go", "straight"):
            raise ValueError(f'progress must be "cost_to_go" or "straight", got "{self.progress}".')
        if self.controls and not self.headings:
            raise ValueError("controls without headings are not a generator: set headings=True.")

    @property
    def generates(self) -> bool:
        """Whether there is a goal generator at all."""
        return self.headings

    @property
    def needs_route(self) -> bool:
        """Whether a cost-to-go is solved for the goal."""
        return self.generates and self.progress == "cost_to_go"


PLANNERS = {
    "drnav": Composition(),
    "drnav-straight": Composition(progress="straight", risk_in_route=False),
    "dwa": Composition(
        headings=False, controls=False, progress="straight", risk_in_route=False, exposure=False, recovery=False
    ),
    "grid": Composition(controls=False, risk_in_route=False, exposure=False),
    "grid+ede": Composition(controls=False, exposure=False),
}


def planner(name: str) -> Composition:
    """The composition of a named planner.

    Raises:
        ValueError: If there is no such planner.
    """
    if name not in PLANNERS:
        raise ValueError(f'There is no planner "{name}": choose from {", ".join(PLANNERS)}.')
    return PLANNERS[name]
