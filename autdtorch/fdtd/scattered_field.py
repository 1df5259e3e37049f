"""The scattered field in a box: driven in heterogeneous cells, radiated from a Huygens surface.

The pressure is p_inc + p_scat, with the exact field p_inc in free space. In heterogeneous cells the scheme
then drives p_scat by the force sum_j (w_ij - w_air) (p_inc,j - p_inc,i), and by the losses of p_inc. A
discrete Huygens surface around them radiates it (`huygens_surface.py`).

Receivers in the box are read by interpolation kernels. Sources there drive by the discrete Green's function
of the same kernels, so that both ways are each other's transpose.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import csr_array
from torch import Tensor

from autdtorch.fdtd.assembly.neighbours import with_neighbours
from autdtorch.fdtd.discrete_green import field_of_kernels
from autdtorch.fdtd.huygens_surface import FaceNodes, HuygensSurface, row_matrix
from autdtorch.fdtd.interpolation import Interpolation
from autdtorch.fdtd.kernels.contract import Sources
from autdtorch.fdtd.kernels.waves import superposition
from autdtorch.fdtd.stencil import flat_offsets, places_of
from autdtorch.fdtd.stepping import Assembly
from autdtorch.utils.apertures import Apertures, Discs, image_of
from autdtorch.utils.array_types import COMPLEX, Array, Index
from autdtorch.utils.mirror_images import NO_MIRRORS, SPACE_ITSELF, Image
from autdtorch.utils.process import cached_property, parts_of_size, spread
from autdtorch.utils.spatial import distinct_cells, places_among

# Distance [cells] from the rim of the interior within which points are not read from the grid. Interpolation
# is poor there, and the Huygens surface, two cells from the rim, is farther than half a cell from such a
# point.
_BESIDE = 1.25
_TOGETHER = 16  # Targets whose waves are computed at once
_NUMBERS = 2**19  # Numbers of incident fields whose forces are computed together
_ROWS = 8192  # Stencil rows that are looked at together, which stay in the cache
_FEWER = 0.7  # Most nodes of the Huygens surface that are worth their errors, relative to its cells


@dataclass(frozen=True, eq=False)
class ScatteredField:
    """An assembled box with its incident and radiated fields."""

    assembly: Assembly
    wavenumber: complex  # complex wavenumber in air [rad/m]
    axes: Array  # axes of the grid, one a row (3, 3)
    images: tuple[Image, ...] = NO_MIRRORS  # of what it radiates; the first is the space itself
    mirrors: tuple[int, ...] = ()  # numbers of those whose images are on its grid
    device: str = "cpu"  # that sums waves

    @property
    def echoes(self) -> tuple[Image, ...]:
        """The images that send back what the box radiates."""
        return self.images[1:]

    @cached_property
    def driven(self) -> Tensor:
        """Positions (n, 3) [m] where the incident field is needed: heterogeneous cells and neighbours."""
        return self.positions(self._driven[0])

    def forces(self, fields: Tensor) -> Tensor:
        """Return forces (h, R) on heterogeneous cells of incident fields (n, R) at `driven` positions."""
        assembly, around = self.assembly, self._driven[1]
        factor = assembly.coefficients.face / assembly.stencil.face
        values = torch.view_as_real(fields.contiguous()).flatten(1).numpy()
        force = np.empty((len(around), values.shape[1]))

        def add(ends: tuple[int, int]) -> None:
            rows = slice(*ends)
            weight = factor * (assembly.heterogeneous.weight[rows] - assembly.stencil.weights)
            weight[:, 13] -= weight.sum(axis=1)  # they are of differences from the cell itself
            force[rows] = row_matrix(weight, around[rows], len(values)) @ values

        spread(add, parts_of_size(len(around), _ROWS))
        total = torch.view_as_complex(torch.from_numpy(force).reshape(len(around), fields.shape[1], 2))
        if len(lossy := assembly.coefficients.loss_index):
            place = np.searchsorted(assembly.heterogeneous.index, lossy.numpy())
            change = 1 - np.exp(2j * np.pi / float(assembly.steps_per_period))  # over a step, of a phasor
            loss, ground = assembly.coefficients.loss_weight, assembly.coefficients.loss_ground
            matrix = row_matrix(loss.double().numpy(), around[place], len(values))
            total[place] += change * torch.from_numpy(matrix @ fields.numpy())
            total[place] -= ground.double()[:, None] * fields[around[place, 13]]
        return total

    def sources(self, force: Tensor) -> Sources:
        """Return complex forces (h, R) at the heterogeneous cells of R runs as kernels take them."""
        both = torch.view_as_real(force.mT).to(self.assembly.dtype)
        return Sources(torch.from_numpy(self.assembly.heterogeneous.index), both)

    def waves(
        self,
        points: Tensor | Discs,
        sources: Tensor | Discs,
        amplitude: Tensor,
        images: Sequence[Image] = NO_MIRRORS,
    ) -> Tensor:
        """Return fields (P, R) at points (P, 3) [m] of images of sources (N, 3), amplitudes (N, R) [Pa m]."""

        def of(image: Image) -> Tensor:
            seen = sources if image is SPACE_ITSELF else image_of(sources, image)
            settings = self.wavenumber, self.assembly.dtype, self.device
            field = superposition(points, seen, amplitude, *settings)
            return field if image is SPACE_ITSELF else image.weight * field

        total = of(images[0])
        for image in images[1:]:
            total = total + of(image)
        return total

    def incident(self, points: Tensor | Discs, sources: Apertures, strength: Tensor) -> Tensor:
        """Return the incident field (P,) at points (P, 3) [m] of sources with strengths (N,) [Pa m]."""
        return self.waves(points, sources.places, strength[:, None])[:, 0]

    def driving(self, drives: Sequence[tuple[Apertures, Tensor]]) -> Tensor:
        """Return forces (h, R) of the incident fields of R drives, sources and strengths (N,) [Pa m]."""
        ends = parts_of_size(len(drives), max(1, _NUMBERS // max(1, len(self.driven))))
        return torch.cat(spread(self._driving, [drives[slice(*each)] for each in ends]), dim=1)

    def _driving(self, drives: Sequence[tuple[Apertures, Tensor]]) -> Tensor:
        fields, further = (
            torch.zeros((count, len(drives)), **COMPLEX) for count in (len(self.driven), len(self._driven[1]))
        )
        for run, (sources, strength) in enumerate(drives):
            near = self._in_box(sources)
            fields[:, run] = self.incident(self.driven, sources.chosen(~near), strength[~near])
            if near.any():
                on_grid, further[:, run] = self._driving_on_grid(sources.chosen(near), strength[near])
                fields[:, run] += on_grid
        return self.forces(fields) + further

    def _driving_on_grid(self, sources: Apertures, strength: Tensor) -> tuple[Tensor, Tensor]:
        """Return the incident field (n,) of sources in the box, and forces (h,) beyond those it causes.

        Nodes in the box are spread over cells. Those of another mass than air's take another force.
        """
        grid, cells, driven = self.assembly.grid, self.assembly.heterogeneous, self.driven
        nodes, shares = sources.positions, strength[:, None] * sources.weights
        inside = self.inside(nodes)
        kernels = self.assembly.interpolation(self._on_axes(nodes[inside]))
        owner = inside.nonzero()[:, 0].numpy()
        field, force = torch.zeros(len(driven), **COMPLEX), torch.zeros(len(cells.index), **COMPLEX)
        places = places_of(self._driven[0], grid.shape)
        for number, within in enumerate(inside):
            rows, source = owner == number, slice(number, number + 1)
            weight = sources.weights[within, None].numpy() * kernels.weight[rows]
            spread = Interpolation(kernels.index[rows], weight)
            near, wave = field_of_kernels(spread, places, grid.shape, self.assembly.stencil)
            field[~near] += self.incident(driven[~near], sources.chosen(source), strength[source])
            field[near] += strength[number] * torch.from_numpy(wave / grid.spacing)
            if not within.all():
                outside = Apertures(nodes[number, ~within])
                field[near] += self.incident(driven[near], outside, shares[number, ~within])
        index, source_force = self.assembly.forces(kernels, shares[inside])
        shared, ours, theirs = np.intersect1d(cells.index, index, assume_unique=True, return_indices=True)
        force[ours] = torch.from_numpy(1 / cells.mass_of(shared) - 1) * source_force[theirs]
        return field, force

    def near_to_far(self, targets: Apertures) -> NearToFar:
        """Return the transform to P targets, which take the mean over their nodes or discs."""
        surface = self.surface.cells
        far = ~self._in_box(targets)
        nodes = targets.positions[~far]
        within = self.inside(nodes)
        inner = self.assembly.interpolation(self._on_axes(nodes[within]))
        count = math.prod(self.assembly.grid.shape)
        around = distinct_cells(inner.index, count)
        cells = distinct_cells(np.concatenate((surface, around)), count)
        outward = slice(None) if len(cells) == len(surface) else np.searchsorted(cells, surface)
        read, matrix = np.searchsorted(cells, around), inner.matrix(around)
        return NearToFar(self, targets, far, within, cells, outward, read, matrix)

    def radiated(
        self, amplitude: Tensor, points: Tensor | Discs, images: Sequence[Image] | None = None
    ) -> Tensor:
        """Return fields (P, R) at points (P, 3) [m] of the Huygens surface with amplitudes (n, R) [Pa m].

        By default with all images of it. To points at a distance, few nodes radiate instead of the cells.
        """
        images = self.images if images is None else images
        far = self._far(points, images)
        field = torch.zeros((len(far), amplitude.shape[1]), **COMPLEX)
        if not far.all():
            field[~far] = self.waves(_chosen(points, ~far), self.radiating, amplitude, images=images)
        if far.any():
            assert self._nodes
            nodes, amplitude = self.places_of(self._nodes), self._nodes.amplitudes(amplitude)
            field[far] = self.waves(_chosen(points, far), nodes, amplitude, images=images)
        return field

    def nodes_for(self, points: Tensor) -> FaceNodes | None:
        """Return the nodes that radiate like the surface to all points (P, 3) and by all images, or None."""
        return self._nodes if self._far(points, self.images).all() else None

    def places_of(self, nodes: FaceNodes) -> Tensor:
        """Return the positions (m, 3) [m] of nodes."""
        return torch.from_numpy(nodes.positions @ self.axes)

    def _far(self, points: Tensor | Discs, images: Sequence[Image]) -> Tensor:
        """Return the mask of points (P, 3) or discs that the surface's nodes and their images reach."""
        points, radii = (points.centers, points.radii.numpy()) if isinstance(points, Discs) else (points, 0.0)
        if self._nodes is None:
            return torch.zeros(len(points), dtype=torch.bool, device="cpu")
        seen = [self._on_axes((points - image.offset) @ image.matrix).numpy() for image in images]
        return torch.from_numpy(np.all([self._nodes.reach(each, radii) for each in seen], axis=0))

    @cached_property
    def _nodes(self) -> FaceNodes | None:
        """Nodes that radiate like the surface, if they are fewer; None in double precision."""
        if self.assembly.dtype != torch.float32:
            return None
        nodes = FaceNodes.of(self.assembly.grid, self.surface.cells, self.wavenumber.real, self.device)
        return nodes if len(nodes.positions) < _FEWER * len(self.surface.cells) else None

    def inside(self, points: Tensor, margin: Tensor | float = 0.0) -> Tensor:
        """Return the mask of points (..., 3) read from the grid; others are clear of the Huygens surface.

        Points up to a margin (...,) [m] outside count too.
        """
        grid = self.assembly.grid
        cells = torch.from_numpy(grid.to_cells(self._on_axes(points)))
        first, last = torch.tensor([grid.first, grid.last], dtype=torch.int64, device="cpu").unbind()
        rim = torch.as_tensor(_BESIDE - margin / grid.spacing, device="cpu")[..., None]
        return ((cells > first + rim) & (cells < last - 1 - rim)).all(dim=-1)

    def _in_box(self, apertures: Apertures) -> Tensor:
        """Return the mask (N,) of sources or receivers with any of their nodes in the box."""
        near = self.inside(apertures.centers, 0.0 if apertures.radii is None else apertures.radii)
        near[near.clone()] = self.inside(apertures.chosen(near).positions).any(dim=1)
        return near

    def read_at(self, points: Tensor) -> Tensor:
        """Return the places (P, 3) [m] that are read for points (P, 3) [m]; see `Assembly.read_at`."""
        inside, places = self.inside(points), points.clone()
        if inside.any():
            on_axes = self.assembly.read_at(self._on_axes(points[inside]))
            places[inside] = on_axes @ torch.from_numpy(self.axes)
        return places

    def enclosed(self, points: Tensor) -> Tensor:
        """Return the mask of points (..., 3) [m] in air that rigid bodies enclose."""
        enclosed, inside = torch.zeros(points.shape[:-1], dtype=torch.bool, device="cpu"), self.inside(points)
        if inside.any():
            enclosed[inside] = torch.from_numpy(self.assembly.is_enclosed(self._on_axes(points[inside])))
        return enclosed

    def positions(self, cells: Index) -> Tensor:
        """Return the centres (n, 3) [m] of cells."""
        return torch.from_numpy(self.assembly.grid.centers_of(cells) @ self.axes)

    def _on_axes(self, points: Tensor) -> Tensor:
        """Return points (..., 3) [m] in the coordinates of the grid."""
        return points @ torch.from_numpy(self.axes.T)

    @cached_property
    def _driven(self) -> tuple[Index, NDArray[np.int32]]:
        """Cells where the incident field is needed, and the neighbours (n, 27) by their place among them."""
        shape, index = self.assembly.grid.shape, self.assembly.heterogeneous.index
        cells = np.flatnonzero(with_neighbours(index, shape))
        place, around = places_among(cells, math.prod(shape)), np.empty((len(index), 27), np.int32)

        def look(ends: tuple[int, int]) -> None:
            around[slice(*ends)] = place[index[slice(*ends), None] + flat_offsets(shape)]

        spread(look, parts_of_size(len(index), _ROWS))
        return cells, around

    @cached_property
    def surface(self) -> HuygensSurface:
        """The Huygens surface."""
        assembly = self.assembly
        scale = assembly.coefficients.face / assembly.stencil.face
        return HuygensSurface.of(assembly.grid, assembly.stencil, scale, float(assembly.steps_per_period))

    @cached_property
    def radiating(self) -> Tensor:
        """Positions (n, 3) [m] of the cells of the Huygens surface."""
        return self.positions(self.surface.cells)


def _chosen(points: Tensor | Discs, mask: Tensor) -> Tensor | Discs:
    return Discs(*(part[mask] for part in points)) if isinstance(points, Discs) else points[mask]


@dataclass(frozen=True)
class NearToFar:
    """The near-to-far-field transform from phasors of a box's cells to the scattered field at P targets."""

    box: ScatteredField
    targets: Apertures
    far: Tensor  # mask of the targets none of whose nodes is in the box (P,)
    within: Tensor  # mask of the other targets' nodes in the box, where its cells are read (Q, n)
    cells: Index  # flat indices (k,) of the cells whose phasors are needed
    outward: slice | Index  # the Huygens surface's cells among those
    read: Index  # the cells about the nodes in the box among those (r,)
    inward: csr_array  # field at these nodes from the phasors of `read` (q, r)

    def field(self, phasors: Tensor) -> Tensor:
        """Return scattered fields (P, R) at the targets, from the cells' phasors (k, R) in R runs."""
        inner = self.inward @ phasors[self.read].cpu().numpy()
        return self._mean(self.amplitudes(phasors), torch.from_numpy(inner))

    def radiated(self, amplitude: Tensor) -> Tensor:
        """Return scattered fields (P, R) at targets outside the box, from amplitudes (n, R) [Pa m]."""
        assert not self.within.any()
        return self._mean(amplitude, amplitude[:0])

    def _mean(self, amplitude: Tensor, inner: Tensor) -> Tensor:
        """Return the means (P, R) over the targets' nodes; `inner` is the field at nodes in the box."""
        near, runs = self.targets.chosen(~self.far), amplitude.shape[1]
        field = torch.zeros((*self.within.shape, runs), **COMPLEX)
        field[self.within] = inner
        if self.box.echoes and self.within.any():
            field[self.within] += self.box.radiated(amplitude, near.positions[self.within], self.box.echoes)
        field[~self.within] = self.box.radiated(amplitude, near.positions[~self.within])
        mean = torch.zeros((len(self.far), runs), **COMPLEX)
        mean[~self.far] = torch.einsum("pnr,n->pr", field, near.weights.to(field.dtype))
        if self.far.any():
            mean[self.far] = self.box.radiated(amplitude, self.targets.chosen(self.far).places)
        return mean

    def amplitudes(self, phasors: Tensor) -> Tensor:
        """Return amplitudes (n, R) [Pa m] of the Huygens surface on the device of the phasors (k, R)."""
        return self.box.surface.of_phasors(phasors[self.outward])

    def matrices(self, every: int) -> FieldMatrices:
        """Return the matrices of each `every`-th target."""
        chosen, weights = torch.arange(0, len(self.far), every, device="cpu"), self.targets.weights
        far = self.far[chosen]
        near = (torch.cumsum(~self.far, 0) - 1)[chosen[~far]]  # their numbers among all near targets
        within, some = self.within[near], self.targets.chosen(chosen[~far])
        kind = torch.complex64 if self.box.assembly.dtype == torch.float32 else torch.complex128
        nodes = self.box.nodes_for(self.targets.chosen(chosen).positions.flatten(0, 1))
        radiating = self.box.radiating if nodes is None else self.box.places_of(nodes)
        received = torch.zeros((len(radiating), len(far)), dtype=kind, device="cpu")
        # reciprocity of Green's function
        self._receive(received, radiating, ~far, some, weights * ~within, False, self.box.images)
        if self.box.echoes and within.any():
            self._receive(received, radiating, ~far, some, weights * within, False, self.box.echoes)
        others, ones = self.targets.chosen(chosen[far]), weights.sum().expand(int(far.sum()), 1)
        self._receive(received, radiating, far, others, ones, True, self.box.images)
        read = torch.zeros_like(self.within)
        read[near] = within
        row, node = torch.nonzero(within, as_tuple=True)
        place = torch.nonzero(~far)[row, 0].numpy(), np.arange(len(row))
        mean = csr_array((weights[node].numpy(), place), (len(far), len(row)))
        inner = csr_array(mean @ self.inward[read[self.within].numpy()])
        return FieldMatrices(self, nodes, received, inner)

    def _receive(
        self,
        received: Tensor,
        radiating: Tensor,
        kind: Tensor,
        targets: Apertures,
        weights: Tensor,
        far: bool,
        images: Sequence[Image],
    ) -> None:
        """Add waves from places `radiating` (m, 3) to the targets of a `kind` (P,) to their columns (m, P).

        Weights are those of their nodes (p, n); targets that are `far` have one each.
        """
        numbers = torch.nonzero(kind)[:, 0]
        for first in range(0, len(weights), _TOGETHER):
            rows = slice(first, first + _TOGETHER)
            some, of_nodes = targets.chosen(rows), weights[rows]
            columns = torch.arange(len(of_nodes), device="cpu").repeat_interleave(of_nodes.shape[1])
            amplitude = torch.zeros((of_nodes.numel(), len(of_nodes)), **COMPLEX)
            amplitude[torch.arange(len(columns), device="cpu"), columns] = of_nodes.flatten().to(amplitude)
            sources = some.places if far else some.positions.flatten(0, 1)
            waves = self.box.waves(radiating, sources, amplitude, images=images)
            received[:, numbers[rows]] += waves.to(received.dtype)


@dataclass(frozen=True)
class FieldMatrices:
    """The scattered field at P targets, as matrices that are built once for many phasors."""

    transform: NearToFar
    nodes: FaceNodes | None  # those that stand for the surface, where they reach all targets
    received: Tensor  # waves from the surface, or from its nodes, to the targets (n, P)
    inner: csr_array  # field at the targets in the box from the phasors of `transform.read` (P, r)

    def field(self, phasors: Tensor) -> Tensor:
        """Return the scattered field (P, R) at the targets, from the cells' phasors (k, R)."""
        amplitude = self.transform.amplitudes(phasors)
        amplitude = self.nodes.amplitudes(amplitude) if self.nodes else amplitude.cpu()
        # by NumPy: in single precision PyTorch may take products of a few bits
        outside = self.received.numpy().T @ amplitude.to(self.received.dtype).numpy()
        return torch.from_numpy(outside + self.inner @ phasors[self.transform.read].cpu().numpy())
