"""The obstacles of a box as a body of multiple scattering, and the waves between boxes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import torch

from autdtorch.fdtd.box_coupling import Coupling, coupling_of
from autdtorch.fdtd.kernels.contract import Kernel, Sources
from autdtorch.fdtd.scattered_field import NearToFar, ScatteredField
from autdtorch.fdtd.short_runs import short_runs
from autdtorch.fdtd.steady_state import Observe, SteadyState, run_to_steady_state
from autdtorch.propagators.plan import Plan
from autdtorch.propagators.simulation import Stepped
from autdtorch.utils.array_types import COMPLEX, REAL, Index
from autdtorch.utils.mirror_images import Image, Mirror
from autdtorch.utils.process import cached_property


@dataclass(frozen=True, eq=False)
class Couplings:
    """The couplings between the boxes of a region with mirrors, each computed once."""

    mirrors: Sequence[Mirror]
    _known: dict[tuple[ScatteredField, ScatteredField], Coupling] = field(default_factory=dict, repr=False)

    def between(self, target: ScatteredField, source: ScatteredField, images: Sequence[Image]) -> Coupling:
        """Return the coupling from a box to another or to itself; see `coupling_of`."""
        key = target, source
        if key not in self._known:
            self._known[key] = coupling_of(target, source, images)
        return self._known[key]

    def images_towards(self, target: ScatteredField, source: ScatteredField) -> Sequence[Image]:
        """Return the images of a box that drive another: as for receivers, both sides of mirrors count alike.

        A mirror that both hold is left out: the other drives its own image. See `Simulation.seen_twice`.
        """
        images = source.images
        for number in sorted(set(source.mirrors) - set(target.mirrors)):
            half = [image._replace(weight=image.weight / 2) for image in images]
            images = (*half, *(image.after(self.mirrors[number].image) for image in half))
        return images


@dataclass(frozen=True, eq=False)
class BoxScatterer:
    """The obstacles of a box, whose answers to incident fields are simulated.

    The `echo` is what mirrors send back, None without mirrors. It drives the run itself, or where some waves
    are summed one by one, it is a further incident field.
    """

    plan: Plan
    kernel: Kernel
    couplings: Couplings
    stepped: Stepped
    transform: NearToFar

    @cached_property
    def echo(self) -> Coupling | None:
        """The coupling of the box to itself by mirrors."""
        box = self.transform.box
        return self.couplings.between(box, box, box.echoes) if box.echoes else None

    @property
    def comes_back_later(self) -> bool:
        """True if mirrors send back an incident field of a further run."""
        return self.echo is not None and bool(self.echo.rest)

    def answers(
        self,
        incoming: torch.Tensor,
        tolerances: Sequence[float],
        observe: Observe | None = None,
        floors: torch.Tensor | None = None,
    ) -> list[SteadyState]:
        """Simulate the answers to forces (h, R) until all that is observed has converged.

        They are phasors of some cells. By default, the amplitudes of the Huygens surface are observed.
        """
        box, cells, plan = self.transform.box, self.transform.cells, self.plan
        # without those of obstacles of air, and of drives that cancel
        loud = box.sources(incoming).force.any(dim=(1, 2)).nonzero()[:, 0].numpy()

        def drive(runs: Index) -> Sources:
            return box.sources(incoming[:, loud[runs]])

        def echoed(phasors: torch.Tensor, runs: Index) -> Sources:
            assert self.echo
            back = self.echo.field(self.outgoing(phasors))
            return box.sources(incoming[:, loud[runs]] + box.forces(back))

        def observed(phasors: torch.Tensor, runs: Index) -> Sequence[torch.Tensor]:
            return observe(phasors, loud[runs]) if observe else [self.outgoing(phasors.cpu())]

        course = box.assembly, self.kernel, drive, cells
        if plan.is_short:
            states = short_runs(*course, len(loud), plan.max_periods, self.stepped)
        else:
            states = run_to_steady_state(
                *course, [tolerances[run] for run in loud], plan.max_periods, observed, self.stepped,
                torch.zeros((1, len(loud)), **REAL) if floors is None else floors[:, loud],
                echoed if self.echo and not self.comes_back_later else None,
            )  # fmt: skip
        nothing = torch.zeros(len(cells), **COMPLEX).to(self.kernel.device)
        silent = SteadyState(nothing, 0, 0.0, True)
        answers = [silent] * len(tolerances)
        for run, state in zip(loud, states, strict=True):
            answers[run] = state
        return answers

    def outgoing(self, phasors: torch.Tensor) -> torch.Tensor:
        """Return the amplitudes of the Huygens surface."""
        return self.transform.amplitudes(phasors)

    def incoming(self, other: BoxScatterer, outgoing: torch.Tensor) -> torch.Tensor | None:
        """Return the forces (h, R) of what a Huygens surface radiates to this box; None if nothing comes.

        Its own comes back by mirrors, as far as its runs do not include that.
        """
        box, here = other.transform.box, self.transform.box
        if other is self and not self.comes_back_later:
            return None
        images = box.echoes if other is self else self.couplings.images_towards(here, box)
        coupling = self.couplings.between(here, box, images)
        fields = coupling.field(outgoing)
        if coupling.rest:
            fields = fields + box.radiated(outgoing, here.driven, coupling.rest)
        return here.forces(fields)
