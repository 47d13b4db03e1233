"""Steady states of many plants of one topology at once, on the host."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np
from numpy.typing import ArrayLike

from jaxtank.analysis.steady_state import check_rest, levels_of, rest, starts
from jaxtank.core.errors import InputError
from jaxtank.plants.tank_network import OPTIONS

FLOWS = ("drain", "orifice", "pipe", "pump_gain", "split", "gravity")
"""Leaves of a TankNetwork that its steady states depend on."""


def flow_leaves(plant: Any) -> tuple[str, ...]:
    """Return the leaves of a network that its steady states depend on, without absent ones."""
    more = ("valve", "rangeability", *OPTIONS)
    return FLOWS + tuple(name for name in more if getattr(plant, name) is not None)


ITERATIONS = 60  # Newton steps at most, for networks with pipes


class SteadyStates:
    """The steady states of N plants that differ in numbers, as a function of their outputs."""

    # Without pipes, efflux speeds and inputs are affine in the roots of the outputs: solved once;
    # with pipes by Newton's method; of a network that is not plain in a compiled program.

    def __init__(
        self,
        plant: Any,
        values: Mapping[str, ArrayLike],
        inflow: ArrayLike = 0.0,
        shared: Any = None,
    ):
        if plant.pumps != len(plant.outputs) and shared is None:
            raise InputError(
                "a steady state needs as many pumps as outputs: this rig has"
                f" {plant.pumps} and {len(plant.outputs)}"
            )
        count = max([1, *(np.shape(v)[0] for v in values.values())])
        leaves = {}
        for name in flow_leaves(plant):
            value = np.asarray(values.get(name, getattr(plant, name)), dtype=float)
            batched = value if name in values else value[None]
            leaves[name] = np.broadcast_to(batched, (count, *batched.shape[1:]))
        self.plant, self.leaves, self.shared = plant, leaves, shared
        self.inflow = np.broadcast_to(np.asarray(inflow, dtype=float), (count, plant.tanks))
        if not plant.plain and shared is None:
            check_rest(plant, "feasibility")
        if not plant.plain or shared is not None:
            return
        self.out, self.efflux, self.pumps = _balance(plant, leaves)
        self.free = [i for i in range(plant.tanks) if i not in plant.outputs]
        if not plant.pipes:
            self.speeds, self.inputs, self.constant = self._affine()

    def at(self, outputs: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """Return levels (N, P, n) [cm] and inputs (N, P, m) [V] at outputs (P, m) or (N, P, m)."""
        # A level below zero stands for an efflux that would have to flow backwards: no steady state
        # exists. NaN where none was found.
        y = np.asarray(outputs, dtype=float)
        if not self.plant.plain or self.shared is not None:
            return self._of_elements(np.broadcast_to(y, (len(self.inflow), *y.shape[-2:])))
        if self.plant.pipes:
            return self._with_pipes(np.broadcast_to(y, (len(self.out), *y.shape[-2:])))
        weight = 2.0 * self.leaves["gravity"][:, None, None]
        known = np.sqrt(weight) * _root(y, self.plant.knee)[0]
        speeds = known @ self.speeds.swapaxes(1, 2) + self.constant[:, None, : self.plant.tanks]
        inputs = known @ self.inputs.swapaxes(1, 2) + self.constant[:, None, self.plant.tanks :]
        return levels_of(speeds, weight, self.plant.knee), inputs

    def _of_elements(self, y):
        plants, solved = (self.plant, self.leaves, self.inflow, y, self.shared), np.False_
        levels = inputs = np.array(np.nan)
        with jax.enable_x64(True):
            for start in starts(self.plant, y, self.shared):
                x, u, still = _many_at_rest(*plants, start)
                new = (np.asarray(still) & ~solved)[..., None]
                levels = np.where(new, np.stack(x, -1), levels)
                inputs = np.where(new, np.stack(u, -1), inputs)
                solved = solved | new[..., 0]
                if solved.all():
                    break
        return levels, inputs

    def _affine(self):
        """Speeds (N, n, m) and inputs (N, m, m) by controlled speeds, and of the inflow."""
        plant, outputs = self.plant, list(self.plant.outputs)
        columns = np.concatenate([self.efflux[:, :, self.free], self.pumps], axis=2)
        right = np.concatenate([self.efflux[:, :, outputs], self.inflow[:, :, None]], axis=2)
        try:
            with np.errstate(all="ignore"):
                solution = -np.linalg.solve(columns, right)
        except np.linalg.LinAlgError:
            raise InputError(
                "the rig has no unique steady states: its pumps cannot move the outputs"
                " independently"
            ) from None
        whole = np.zeros((len(columns), plant.tanks + plant.pumps, right.shape[2]))
        whole[:, self.free] = solution[:, : len(self.free)]
        whole[:, outputs, range(len(outputs))] = 1.0
        whole[:, plant.tanks :] = solution[:, len(self.free) :]
        unit = whole[:, :, :-1]
        return unit[:, : plant.tanks], unit[:, plant.tanks :], whole[:, :, -1]

    def _with_pipes(self, y):
        """`at` of a network with pipes: Newton with halved steps where one does not help."""
        n, free = self.plant.tanks, self.free
        x = np.empty((*y.shape[:2], n))
        x[..., list(self.plant.outputs)] = y
        x[..., free] = y.max(axis=2, keepdims=True)
        for _ in range(ITERATIONS):
            flow, slope = self._flows(x)
            pumps = np.broadcast_to(self.pumps[:, None], (*x.shape[:2], n, y.shape[2]))
            columns = np.concatenate([slope[..., free], pumps], axis=3)
            try:
                with np.errstate(all="ignore"):
                    move = -np.linalg.solve(columns, flow[..., None])[..., 0]
            except np.linalg.LinAlgError:
                return np.full_like(x, np.nan), np.full_like(y, np.nan)
            step = move[..., : len(free)]
            done = np.abs(step) <= 1e-12 * np.maximum(1e-6, np.abs(x[..., free]))
            if done.all():
                break
            x[..., free] = self._shortened(x, step)
        residual = flow + np.einsum("spnm,spm->spn", pumps, move[..., len(free) :])
        lost = np.abs(residual).max(axis=2) > 1e-8 * np.abs(flow).max(axis=2) + 1e-12
        x[lost], u = np.nan, np.where(lost[..., None], np.nan, move[..., len(free) :])
        return x, u

    def _shortened(self, x, step):
        """Levels that are not controlled after a step, halved while the imbalance rises."""
        free, before = self.free, self._imbalance(x)
        share = np.ones((*x.shape[:2], 1))
        for _ in range(8):
            trial = x.copy()
            trial[..., free] += share * step
            worse = self._imbalance(trial) > before
            if not worse.any():
                break
            share = np.where(worse[..., None], 0.5 * share, share)
        return trial[..., free]

    def _imbalance(self, x):
        """(N, P) flow that no inputs can balance, as a norm."""
        flow, _ = self._flows(x)
        inputs = np.einsum("smn,spn->spm", np.linalg.pinv(self.pumps), flow)
        return np.linalg.norm(flow - np.einsum("snm,spm->spn", self.pumps, inputs), axis=2)

    def _flows(self, x):
        """(N, P, n) flow into each tank without pumps [cm^3/s], (N, P, n, n) its slopes."""
        plant, w = self.plant, np.sqrt(2.0 * self.leaves["gravity"])[:, None]
        root, steep = _root(x, plant.knee)
        flow = np.einsum("sij,spj->spi", self.efflux, root) * w[..., None] + self.inflow[:, None]
        slope = self.efflux[:, None] * steep[:, :, None] * w[..., None, None]
        for k, (upper, other) in enumerate(plant.pipes):
            z = x[..., upper] - x[..., other]
            square = z * z + plant.knee * plant.knee  # `smooth_signed_sqrt` and its slope
            s, ds = z / square**0.25, (1.0 - 0.5 * z * z / square) / square**0.25
            size = self.leaves["pipe"][:, k, None] * w
            for tank, sign in ((upper, -1.0), (other, 1.0)):
                flow[..., tank] += sign * size * s
                slope[..., tank, upper] += sign * size * ds
                slope[..., tank, other] -= sign * size * ds
        return flow, slope


@jax.jit
def _many_at_rest(plant, leaves, inflow, outputs, shared, start):
    """(levels, inputs, whether at rest) of plants and outputs, (N, P) each."""
    at = lambda leaves, inflow, y: rest(
        dataclasses.replace(plant, **leaves), y, inflow, start, shared
    )
    return jax.vmap(jax.vmap(at, in_axes=(None, None, 0)))(leaves, inflow, outputs)


def _balance(plant, leaves):
    """Efflux (n, n) [cm^2], pumps (n, m): A_i h_i' = efflux @ speeds + pumps @ inputs, no pipes."""
    out = np.array(leaves["drain"])
    count, n = out.shape
    efflux, pumps = np.zeros((count, n, n)), np.zeros((count, n, plant.pumps))
    for k, (source, sink) in enumerate(plant.links):
        out[:, source] += leaves["orifice"][:, k]
        efflux[:, sink, source] += leaves["orifice"][:, k]
    efflux[:, range(n), range(n)] -= out
    for j, (first, second) in enumerate(plant.feeds):
        share = 1.0 if second is None else leaves["split"][:, j]
        pumps[:, first, j] += share * leaves["pump_gain"][:, j]
        if second is not None:
            pumps[:, second, j] += (1.0 - share) * leaves["pump_gain"][:, j]
    return out, efflux, pumps


def _root(h, knee):
    """`smooth_sqrt` and its slope."""
    deep, x = h >= knee, np.maximum(h, 0.0) / knee
    root = np.sqrt(np.where(deep, h, 1.0))
    laminar = (1.5 * h / knee - 0.5 * np.minimum(x, 1.0) ** 2) * knee**0.5
    slope = (1.5 - np.minimum(x, 1.0)) * knee**-0.5
    return np.where(deep, root, laminar), np.where(deep, 0.5 / root, slope)
