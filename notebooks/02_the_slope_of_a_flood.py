# %% [markdown]
# # The slope of a flood
#
# **Question:** How do a volume lost over a rim and the levels of a rig depend on the numbers of a
# controller, and when can one trust the derivative?
#
# First one tank from scratch, in 20 lines of JAX; then the four-tank rig of [Gouta, Hadj Said and
# M'sahli (2015)](https://doi.org/10.1016/j.jfranklin.2015.08.004), whose runs are differentiated in the
# same way.
#
# Run time: about {{run_time}} s. {{links}}

# %%
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import jaxtank
from jaxtank.core.numerics import smooth_sqrt
from jaxtank.plots.style import PUBLISHED, REFERENCE, RIM, TUNED

jaxtank.notebook()

# %% [markdown]
# ## One tank, twenty lines
#
# A tank of cross-section $A$ under a pump and above an outlet of area $a$, and a PI controller of its
# level:
#
# $$A\,\dot h = k\,u - a\sqrt{2 g h}, \qquad u = K_c\,(r - h) + z, \qquad
#   \dot z = \frac{K_c}{T_i}\,(r - h), \qquad 0 \le u \le 12\ \mathrm{V}.$$
#
# What rises above the rim is lost; its volume is counted. The steps are Euler's, to keep it short.

# %%
A, K, OUTLET, DT = 50.0, 40.0, 0.5, 0.1  # cm², cm³/(s V), cm², s
KC, LOW, HIGH = 0.2, 0.0, 12.0  # V/cm, V, V


def rate(h, u):  # of the level, cm/s
    return (K * u - OUTLET * jnp.sqrt(2 * 981.0 * h)) / A


# %%
def step(state, r, Ti, rim):
    h, z, lost = state
    u = jnp.clip(KC * (r - h) + z, LOW, HIGH)
    h, z = h + DT * rate(h, u), z + DT * KC / Ti * (r - h)
    over = jnp.maximum(h - rim, 0.0)
    return (h - over, z, lost + A * over), h - over


@jax.jit
def flood(Ti, rim=22.0):
    r, start = jnp.where(jnp.arange(1500) < 100, 5.0, 20.0), (5.0, 1.238, 0.0)  # at rest
    (_, _, lost), levels = jax.lax.scan(lambda s, r: step(s, r, Ti, rim), start, r)
    return lost, levels


# %% [markdown]
# **Guess first:** the rim is at 22 cm, and the setpoint steps from 5 to 20 cm. Of the integral times 2,
# 4 and 12 s, which ones make the tank overflow?

# %%
t = DT * np.arange(1, 1501)
fig, ax = plt.subplots(figsize=(7, 2.8), layout="constrained")
ax.plot(t, np.stack([flood(Ti)[1] for Ti in (2.0, 4.0, 12.0)]).T, label=["2 s", "4 s", "12 s"])
ax.axhline(22, color=RIM, label="rim")
ax.set(xlabel="time [s]", ylabel="level [cm]")
ax.legend();

# %% [markdown]
# The first two: {{float(flood(2.0)[0]):.0f}} and {{float(flood(4.0)[0]):.0f}} cm³. The integral
# grows as long as the level is below its setpoint, and shrinks only after the level has passed it.
#
# ## The derivative
#
# `jax.grad` differentiates all 1,500 steps. The central difference runs the tank twice more.

# %%
volume = lambda Ti: flood(Ti)[0]
slope = jax.jit(jax.grad(volume))
difference = (volume(4.0 + 1e-4) - volume(4.0 - 1e-4)) / 2e-4
float(slope(4.0)), float(difference)

# %% [markdown]
# {{float(slope(4.0)):.2f}} cm³ per second of $T_i$, by both. Next, the volume over the integral time, with
# the tangents at three points.
#
# **Guess first:** from which of the three tangents can one find the integral time at which the floor
# becomes dry?

# %% tags=["thumbnail"]
Ti = np.linspace(1.5, 12.0, 200)
fig, ax = plt.subplots(figsize=(7, 3.4), layout="constrained")
ax.plot(Ti, jax.vmap(volume)(Ti), color=TUNED, label="volume lost")
for at in (2.0, 4.0, 9.0):
    ends = np.array([-1.5, 1.5])
    ax.plot(at + ends, volume(at) + slope(at) * ends, "--", color=PUBLISHED)
    ax.plot(at, volume(at), "o", color=PUBLISHED)
ax.plot([], [], "o--", color=PUBLISHED, label="tangents")
ax.set(xlabel="integral time Ti [s]", ylabel="volume lost [cm^3]", ylim=(-60, None))
ax.legend();

# %% [markdown]
# From the left ones, roughly: they point to a longer integral time, but reach zero too early, because
# the curve is convex. The right one is exact as well, and useless: where nothing is lost, the slope is
# {{float(slope(9.0)):.0f}}. A search for the shortest integral time with a dry floor stands still anywhere on
# this side. That is the first way in which a derivative misleads: **it does not see beyond a flat
# piece**.
#
# ## Ask a better question
#
# Take the rim away (put it at 1 km), and ask for the highest level. As long as the level overshoots, it
# has a slope, on both sides of the 22 cm. Newton's rule then finds the integral time at which the level just touches the rim:
#
# $$T_i \leftarrow T_i + \frac{22\ \mathrm{cm} - h_{\max}(T_i)}{h'_{\max}(T_i)}.$$
#
# **Guess first:** from 9 s, how many of these steps are needed to be right to 0.001 s?

# %%
peak = jax.jit(jax.value_and_grad(lambda Ti: flood(Ti, 1e5)[1].max()))
found = [9.0]
for _ in range(5):
    level, along = peak(found[-1])
    found.append(found[-1] + float((22.0 - level) / along))
np.round(found, 4)

# %% [markdown]
# {{int(np.argmax(np.abs(np.array(found) - found[-1]) < 1e-3))}} steps, to {{found[-1]:.3f}} s. With
# 0.01 s more, {{float(volume(found[-1] + 0.01)):.2f}} cm³ are lost; with 0.5 s less,
# {{float(volume(found[-1] - 0.5)):.1f}} cm³. This is how the tuner of the package keeps limits: it asks how far a level is from its rim, not
# how much was lost.
#
# ## A root at zero
#
# The second way: a formula that is right forwards and not backwards. A tank that runs empty has
# $\sqrt{h}$ at $h = 0$, and a step may end a little below.
#
# **Guess first:** the flow of an empty tank is 0. What is its derivative, if one writes
# `sqrt(maximum(h, 0))`?

# %%
naive = lambda h: jnp.sqrt(jnp.maximum(h, 0.0))
laminar = lambda h: smooth_sqrt(h, 0.01)
levels = jnp.array([-0.001, 0.0, 0.001, 1.0])
jnp.stack([jax.vmap(jax.grad(f))(levels) for f in (naive, laminar)])

# %% [markdown]
# Below zero it is not a number ($0 \cdot \infty$), at zero infinite, and one such value spoils the
# gradient of a whole run. The plants of the package have a flow that is proportional to the level very
# near the floor (laminar flow, with a smooth transition), so that every derivative is finite (second row).
#
# ## A tangent on a whole run
#
# Four tanks now, 12,000 steps. `jax.jvp` gives the run and its derivative with respect to the gain $k_1$
# in one pass: for each level at each time, how it moves with the gain.


# %%
case = jaxtank.presets.find("gouta2015/backstepping")
case = jaxtank.rig.set_values(case, {"clock.dt": 0.1, "plant.overflow": True})


@jax.jit
def run(k1):
    loop = jaxtank.with_values(case.loop, {"controller.k1": k1})
    return jaxtank.simulate(loop, case.clock, save_every=10).x


levels, along = jax.jvp(run, (0.088,), (1.0,))
real, tangent = run(0.176), levels + 0.088 * along

# %% [markdown]
# **Guess first:** the tangent predicts the run with twice the gain. Where will it be wrong: on the ramps,
# at rest, or at the rim?

# %%
fig, axes = plt.subplots(1, 2, figsize=(9, 3.2), layout="constrained")
for ax, i, ends in zip(axes, (1, 3), ((260, 360), (300, 360)), strict=True):
    ax.plot(levels[:, i], color=PUBLISHED, label="k1 = 0.088 1/s")
    ax.plot(real[:, i], color=TUNED, label="k1 = 0.176 1/s")
    ax.plot(tangent[:, i], "--", color=REFERENCE, label="tangent, at 0.176 1/s")
    inside = np.arange(*ends)
    low, high = (f(np.stack([levels, real, tangent])[:, inside, i]) for f in (np.min, np.max))
    ax.set(title=f"tank {i + 1}", xlabel="time [s]", xlim=ends, ylim=(low - 0.3, high + 0.3))
axes[1].axhline(30, color=RIM)
axes[0].set_ylabel("level [cm]")
axes[0].legend();

# %% [markdown]
# First, on the ramps. The tangent has the right direction, but twice the gain is no small step: for tank 2
# it is worst at {{(worst := 260 + int(jnp.argmax(jnp.abs(tangent - real)[260:330, 1])))}} s, off by
# {{float(jnp.abs(tangent - real)[worst, 1]):.2f}} cm, where the gain moves the level by
# {{float(jnp.abs(levels - real)[worst, 1]):.2f}} cm. (With 10 % more gain it is off by
# {{float(jnp.abs(levels + 0.0088 * along - run(0.0968))[worst, 1]):.3f}} cm there, of
# {{float(jnp.abs(levels - run(0.0968))[worst, 1]):.3f}} cm.) Then, at the rim. Tank 4 stands there from
# {{int(jnp.argmax(levels[:, 3] >= 30.0 - 1e-6))}} s on, and its level does not move with the gain; just
# before, where it still rises, the tangent goes through the rim, up to
# {{float(tangent[:, 3].max()):.1f}} cm. The third way: **a tangent does not know of a limit that the run
# has not reached yet**.

# %% [markdown]
# ## Conclusion
#
# - A simulation in JAX is a function, and its derivative is exact: {{float(slope(4.0)):.2f}} cm³ per
#   second of $T_i$, by `jax.grad` and by differences.
# - Exact is not the same as useful. Where nothing is lost the slope of the lost volume is 0; the highest
#   level has a slope on both sides of the rim, and Newton's rule finds the border at {{found[-1]:.2f}} s.
# - A root at zero needs care, once, in the plant.
# - A tangent is a prediction for small steps between limits. Those who take large steps must run again:
#   the tuner of this package does, at every step.
#
# ## Exercises
#
# **1.** Set `LOW, HIGH = 1.238, 1.238`, so that the pump cannot move. What is the slope of the highest
# level? Guess, then run.
#
# <details><summary>Answer</summary>
#
# 0, exactly: the pump is at its limit all the time, so no gain acts. A search that starts there has
# nothing to go by. Several starts help only where some of them leave the limit. (Run the cells of `step`
# and `flood` again after the change: compiled functions keep the old numbers.)
# </details>
#
# **2.** Find the integral time that just touches a rim at 21 cm.
#
# <details><summary>Answer</summary>
#
# {{(T := [9.0]) and [T.append(T[-1] + float((21.0 - peak(T[-1])[0]) / peak(T[-1])[1])) for _ in range(8)] and T[-1]:.2f}} s: the
# same rule with 21 in place of 22.
# </details>
#
# **3.** At which $k_1$ between 0.088 and 0.176 1/s is the tangent of tank 2 on its ramp wrong by 0.05 cm?
# Try `run` at a few values.
#
# <details><summary>Answer</summary>
#
# At 0.11 1/s it is wrong by
# {{float(jnp.abs(levels + 0.022 * along - run(0.11))[260:330, 1].max()):.3f}} cm, at 0.132 1/s by
# {{float(jnp.abs(levels + 0.044 * along - run(0.132))[260:330, 1].max()):.3f}} cm. So just below 0.11 1/s. Twice
# the step gives about three times the error; an error of pure second order would give four times.
# </details>
