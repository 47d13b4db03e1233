# %% [markdown]
# # What a limit costs
#
# **Question:** How much tracking error does a lower rim cost: with slower gains, with a filter, and with
# the best input that can be found?
#
# The rig is the four-tank rig of [Gouta, Hadj Said and M'sahli
# (2015)](https://doi.org/10.1016/j.jfranklin.2015.08.004) under backstepping, with samples of 0.1 s.
#
# Run time: about {{run_time}} s. {{links}}

# %%
import jax
import matplotlib.pyplot as plt
import numpy as np

import jaxtank
import tuning
from jaxtank.plots.style import FILTERED, PUBLISHED, REFERENCE, RIM, TUNED

jaxtank.notebook()

# %% [markdown]
# ## Two gains, one map
#
# The error is the root of the mean squared errors of the two outputs, summed,
#
# $$J(k, k_1) = \sqrt{\overline{e_1^2} + \overline{e_2^2}},$$
#
# and the limit is on the highest level of any tank, $\max_{i,t} h_i(t) \le H$. With two gains both can
# be drawn: 900 runs, one call.

# %%
case = jaxtank.presets.find("gouta2015/backstepping")
case = jaxtank.rig.set_values(case, {"clock.dt": 0.1})
names = ["rms_error_total", "max_level"]


@jax.jit
@jax.vmap
def outcome(k, k1):
    loop = jaxtank.with_values(case.loop, {"controller.k": k, "controller.k1": k1})
    values = jaxtank.evaluate(loop, case.clock, names)
    return values["rms_error_total"], values["max_level"].max()


# %%
k, k1 = np.meshgrid(np.geomspace(1e-3, 5.0, 30), np.geomspace(5e-3, 5.0, 30))
error, highest = (np.reshape(v, k.shape) for v in outcome(k.ravel(), k1.ravel()))
published = jaxtank.evaluate(case.loop, case.clock, names)

# %% [markdown]
# **Guess first:** colours are the error, lines the highest level. Are the lines parallel to the bands of
# equal error?

# %%
fig, ax = plt.subplots(figsize=(6.6, 4.2), layout="constrained")
ax.set(xscale="log", yscale="log", xlabel="k [1/s]", ylabel="k1 [1/s]")
cuts = np.geomspace(error.min(), error.max(), 20)
filled = ax.contourf(k, k1, error, cuts, cmap="cividis_r", norm="log")
fig.colorbar(filled, label="tracking error, rms [cm]", format="%.2g")
lines = ax.contour(k, k1, highest, [29, 30, 32, 34, 36], colors="black", linewidths=[1, 2, 1, 1, 1])
ax.clabel(lines, fmt="%g cm")
ax.plot(0.03, 0.088, "s", color=PUBLISHED, markeredgecolor="white", label="published")
ax.legend(loc="lower left", labelcolor="white");

# %% [markdown]
# Nearly: a small error comes with a high level. Along the line of 30 cm a larger $k$ lowers the error from
# {{float(np.interp(30.0, highest[:, 0], error[:, 0])):.2f}} to {{float(np.interp(30.0, highest[:, -1], error[:, -1])):.2f}} cm, and no pair of gains on the map does better there.
# The published gains have {{published["rms_error_total"]:.2f}} cm
# and a level of {{float(published["max_level"].max()):.1f}} cm in tanks of 30 cm.
#
# ## Three ways to keep a limit
#
# - **Gains**: for each height $H$, the gains with the least error under the limit
#   (`tuning.tradeoff`; its searches use the exact derivative of the highest level).
# - **A filter**: gains that follow well, and caps on the pumps only where a level comes near $H$
#   (notebook 04).
# - **Physics**: the best input that a search finds with the whole reference known in advance
#   (`tuning.bound`; each input is held for 4 s). It is a numerical optimum and no proof, but a
#   controller that comes near it has little left to gain.

# %%
free = {"controller.k": (1e-3, 5.0), "controller.k1": (1e-3, 5.0)}
heights = np.array([24.0, 26.0, 28.0, 30.0, 31.0, 32.0, 33.0, 34.0])
curve = tuning.tradeoff(case, "max_level", heights[3:], free=free, limits={})["points"]
gains = {point["limit"]: point["objective"] for point in curve}
curve_at = next(point["parameters"] for point in curve if point["limit"] == 30.0)
best = {H: tuning.bound(case, limits={"max_level": H}, interval=4.0, iterations=60).cost
        for H in (24.0, 28.0, 30.0, 34.0)}

# %% [markdown]
# The fast gains are those with the least error without any limit (notebook 01: a large $k_1$); without the
# filter they bring tank 4 above 36 cm.

# %%
fast = jaxtank.rig.set_values(case, {"controller.k": 1.34, "controller.k1": 1.79})


def capped(H):
    held = fast.with_safety_filter(limit=[30.0, 30.0, H, H])
    return float(jaxtank.evaluate(held.loop, held.clock, names)["rms_error_total"])


filtered = {H: capped(H) for H in heights.tolist()}

# %% [markdown]
# **Guess first:** at 30 cm, the height of the tanks: how far apart are the three?

# %% tags=["thumbnail"]
fig, ax = plt.subplots(figsize=(7, 3.6), layout="constrained")
rows = ((gains, TUNED, "o-", "best gains"), (filtered, FILTERED, "^-", "fast gains, filter"),
        (best, REFERENCE, "s--", "best input, known in advance"))
for found, colour, marker, label in rows:
    ax.semilogy(sorted(found), [found[H] for H in sorted(found)], marker, color=colour, label=label)
x, y = published["max_level"].max(), published["rms_error_total"]
ax.plot(x, y, "s", color=PUBLISHED, label="published gains")
ax.axvline(30, color=RIM, label="rim")
ax.set(xlabel="highest level allowed [cm]", ylabel="tracking error, rms [cm]")
ax.legend();

# %% [markdown]
# At 30 cm: {{gains[30.0]:.2f}} cm by gains, {{filtered[30.0]:.3f}} cm by the filter, {{best[30.0]:.3f}} cm
# at best. Most of what the rim costs is not physics. It comes from gains that are the same all the time: to keep
# the highest level of 20 minutes below the rim, they must be slow in every minute. The filter is slow
# only near the limit ({{100 * float(jaxtank.evaluate((held := fast.with_safety_filter()).loop, held.clock, ["filter_active_fraction"])["filter_active_fraction"]):.1f}} %
# of the samples at 30 cm).
#
# With 34 cm the filtered loop ({{filtered[34.0]:.3f}} cm) is even better than the fast gains without any
# limit ({{float(jaxtank.evaluate(fast.loop, case.clock, names)["rms_error_total"]):.3f}} cm): the filter also divides a command between the pumps where one of them is at
# 0 V, and the overshoot after a ramp is less than half as high.
#
# With 28 cm and less the best input pays as well ({{best[28.0]:.2f}} cm, and {{best[24.0]:.2f}} cm with 24 cm): at rest at 16
# and 10 cm, tank 3 stands at 29.5 cm. This part is physics.
#
# ## A slider on the rim
#
# The limit of the filter is a number like any other. In the page below the safety filter has a slider for each limit, and
# the band shows 200 plants whose flows differ by up to 5 %: if you run this notebook, drag both limits to 24 cm.
#
# **Guess first:** which setpoints can no longer be held?

# %%
guarded = fast.with_safety_filter()
lowered = jaxtank.with_values(guarded.loop, {f"safety_filter.limit[{i}]": 24.0 for i in (2, 3)})
lowered = guarded.replace(loop=lowered)
wide, low, many = (tuning.ensemble(c, samples=200) for c in (guarded, lowered, case))
rest, rest2 = (jaxtank.analysis.equilibrium(case.loop.plant, r)[0] for r in ((8, 14), (16, 10)))
guarded.explore(plants=200)

# %% [markdown]
# Two pairs cannot be held: on the nominal plant 8 and 14 cm need {{rest[3]:.1f}} cm in tank 4, and 16 and
# 10 cm need {{rest2[2]:.1f}} cm in tank 3. The levels of both stop at 24 cm on every plant, and the lower tanks
# share the inflow that is left. The mean error over the 200 plants is {{low.measures["rms_error_total"].mean():.2f}} cm, in
# place of {{wide.measures["rms_error_total"].mean():.2f}} cm with limits of 30 cm.

# %% [markdown]
# ## Conclusion
#
# - Under a limit of 30 cm the best gains have an error of {{gains[30.0]:.2f}} cm, fast gains under a filter
#   {{filtered[30.0]:.3f}} cm, and the best input found {{best[30.0]:.3f}} cm.
# - So enforce a level limit only where a level is near it, and tune the gains for the rest of the time. What
#   the fast gains cost is motion of the pumps (exercise 1).
# - Below 29.5 cm a setpoint cannot be held: at 24 cm the best input found has {{best[24.0]:.2f}} cm, the filter
#   {{filtered[24.0]:.2f}} cm. Where both are near each other, change the rig or the setpoints, not the gains.
# - These numbers are without noise. The default answer of `tuning.tune` has a price on the changes of the
#   inputs as well, and keeps the gains lower.
#
# ## Exercises
#
# **1.** What do the fast gains cost the pumps? Compare the total variation of the inputs
# (`input_travel`) with that of the published gains.
#
# <details><summary>Answer</summary>
#
# Under the filter {{np.sum(jaxtank.evaluate(held.loop, held.clock, ["input_travel"])["input_travel"]):.0f}} V for both pumps,
# in place of {{np.sum(jaxtank.evaluate(case.loop, case.clock, ["input_travel"])["input_travel"]):.0f}} V:
# nearly ten times as much, even without noise.
# </details>
#
# **2.** Read the map: which gains on it hold 30 cm with the least error, and what is the use of $k$?
#
# <details><summary>Answer</summary>
#
# The largest $k$ and a $k_1$ of about 0.01 1/s: `tuning.tradeoff` ends at
# $k$ = {{curve_at["controller.k"]:.2g}} and $k_1$ = {{curve_at["controller.k1"]:.2g}} 1/s. A large $k$ makes the
# inner loop fast, so that $k_1$ alone decides how fast the level rises.
# </details>
#
# **3.** The other way round: how high must tanks 3 and 4 be, so that the published gains pass no rim on
# the nominal plant? And on 95 % of 200 plants?
#
# <details><summary>Answer</summary>
#
# {{float(published["max_level"].max()):.1f}} cm, and {{np.quantile(many.measures["max_level"].max(axis=1), 0.95):.1f}} cm
# (`tuning.ensemble(case, samples=200).measures["max_level"]` has the highest levels of each plant).
# </details>
