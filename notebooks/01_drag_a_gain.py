# %% [markdown]
# # Drag a gain
#
# **Question:** What does one number of a controller do to four tanks, and to 200 plants that are
# not exactly the one in the paper?
#
# The rig is the state-coupled four-tank rig of H. Gouta, S. Hadj Said and F. M'sahli,
# [J. Franklin Inst. (2015)](https://doi.org/10.1016/j.jfranklin.2015.08.004), under its
# backstepping controller.
#
# Run time: about {{run_time}} s. {{links}}

# %%
import jax
import matplotlib.pyplot as plt
import numpy as np

import jaxtank
import tuning
from jaxtank.plots.style import PUBLISHED, RIM, TUNED

jaxtank.notebook()

# %% [markdown]
# ## The rig
#
# Two pumps fill the upper tanks 3 and 4. Each upper tank drains into both lower tanks, and the
# levels of the lower tanks follow setpoints. With the cross-section $A$ of a tank, the orifice
# areas $c$ and the gain $b$ of a pump, the upper tank 3 and the lower tank 1 obey
#
# $$A\,\dot h_3 = b\,u_1 - (c_{31} + c_{32})\sqrt{2 g h_3}, \qquad
#   A\,\dot h_1 = c_{31}\sqrt{2 g h_3} + c_{41}\sqrt{2 g h_4} - c_1\sqrt{2 g h_1}.$$
#
# The controller has two gains. With the inflow $z_1$ of tank 1, divided by $A$, and the outflow
# coefficient $s_1 = c_1\sqrt{2g}/A$, it commands the rate
#
# $$\dot z_1 = -(k + k_1)\,\bigl(z_1 - s_1\sqrt{r_1} + k_1 (h_1 - r_1)\bigr),$$
#
# and the same for tank 2: $k_1$ turns an error of the level into an inflow, and $k + k_1$ is the
# speed with which this inflow is reached.

# %%
case = jaxtank.presets.find("gouta2015/backstepping")
case = jaxtank.rig.set_values(case, {"clock.dt": 0.1})
case

# %% [markdown]
# ## One run
#
# **Guess first:** all tanks are {{case.loop.plant.rim[0]:.0f}} cm high, and no setpoint is above 16 cm.
# Does any tank come near its rim?

# %%
run = jaxtank.simulate(case.loop, case.clock)
names = ["rms_error_total", "max_level"]
published = jaxtank.evaluate(case.loop, case.clock, names)
run

# %% [markdown]
# No lower tank comes near its rim. The upper tanks pass theirs: tank 4 rises to {{published["max_level"][3]:.1f}} cm. To follow a
# ramp, a lower tank needs more inflow, and twice the flow through an orifice needs four times the level
# above it. (In this model nothing flows over a rim, so that one sees how far it is
# passed. `plant.overflow` switches that on.)
#
# ## One gain
#
# `evaluate` is a function of the loop. So `jax.vmap` runs it at 41 values of $k_1$ at once.
#
# **Guess first:** with a larger $k_1$, does the error fall? Does the level of tank 4?


# %%
@jax.jit
@jax.vmap
def outcome(k1):
    loop = jaxtank.with_values(case.loop, {"controller.k1": k1})
    values = jaxtank.evaluate(loop, case.clock, names)
    return values["rms_error_total"], values["max_level"][3]


k1 = np.geomspace(0.03, 1.0, 41)
error, level = outcome(k1)

# %%
fig, (left, right) = plt.subplots(1, 2, figsize=(9, 3), layout="constrained")
left.semilogx(k1, error, color=TUNED)
left.axvline(0.088, color=PUBLISHED, linestyle="--", label="published, 0.088 1/s")
left.set(xlabel="k1 [1/s]", ylabel="tracking error, rms [cm]")
left.legend()
right.semilogx(k1, level, color=TUNED, label="tank 4")
right.axvline(0.088, color=PUBLISHED, linestyle="--")
right.axhline(30, color=RIM, label="rim")
right.set(xlabel="k1 [1/s]", ylabel="highest level of tank 4 [cm]")
right.legend();
# %% [markdown]
# The error falls from {{error[0]:.2f}} to {{error[-1]:.2f}} cm, and the level of tank 4 rises from
# {{level[0]:.1f}} to {{level[-1]:.1f}} cm. The two are in conflict: a lower tank that follows a ramp
# closely needs the inflow of a high upper tank. Only at the lower end of the range does tank 4 stay
# within its rim, with twice the published error.
#
# ## 200 plants
#
# The orifices and pumps of a real rig are known to a few per cent. The page below has a slider for each
# number of the loop, and a band of 200 plants whose flows differ from the nominal ones by up to 5 %, while the
# controller uses the nominal ones. If you run this notebook, drag $k_1$ in it.

# %%
case.explore(plants=200)

# %% [markdown]
# The same from Python, with $k_1$ at the published 0.088 1/s and at 0.17 1/s.
#
# **Guess first:** the nominal plant passes the rim by
# {{published["max_level"][3] - 30:.1f}} cm. How high does the worst of the 200 come?

# %% tags=["thumbnail"]
larger = jaxtank.rig.set_values(case, {"controller.k1": 0.17})
before, after = (tuning.ensemble(c, samples=200) for c in (case, larger))
figures = after.plot()
[plt.close(figure) for name, figure in figures.items() if name != "fan"];

# %% [markdown]
# With $k_1$ = 0.17 1/s {{100 * float((after.measures["max_level"] > 30).any(axis=1).mean()):.3g}} % of the plants rise above a rim, and the mean error is
# {{float(after.measures["rms_error_total"].mean()):.3f}} cm in place of {{float(before.measures["rms_error_total"].mean()):.3f}} cm. The worst plant comes to
# {{float(before.measures["max_level"].max()):.1f}} cm with the published gain, and to
# {{float(after.measures["max_level"].max()):.1f}} cm with the larger one.
#
# **Guess first:** each plant is a point of (highest level, error). Which way does the larger gain
# move the points?

# %%
fig, ax = plt.subplots(figsize=(6, 3.4), layout="constrained")
shown = ((before, PUBLISHED, "s", "0.088"), (after, TUNED, "o", "0.17"))
for plants, colour, marker, gain in shown:
    x, y = plants.measures["max_level"].max(axis=1), plants.measures["rms_error_total"]
    ax.plot(x, y, marker, color=colour, markersize=3, alpha=0.6, label=f"k1 = {gain} 1/s")
ax.axvline(30, color=RIM, label="rim")
ax.set(xlabel="highest level of any tank [cm]", ylabel="tracking error, rms [cm]")
ax.legend();
# %% [markdown]
# Down, which is good, and to the right, which is not. For the level the clouds are much wider than
# the distance between them: 5 % in the flows matters more than a gain twice as large.
# A plant whose lower outlets are wide needs more inflow, and so a higher level in an upper tank.
#
# ## Give it more time?
#
# The setpoints move in ramps of 60 s. Slower ramps need less inflow.
#
# **Guess first:** on how many of 200 plants does a level still pass its rim if the ramps take 120 s?

# %%
ramps = np.array([15.0, 30.0, 60.0, 90.0, 120.0])


def share_above(ramp):
    slower = jaxtank.rig.set_values(case, {"reference.ramp": ramp})
    found = tuning.ensemble(slower, samples=200, measures=("max_level",))
    return np.mean(np.asarray(found.measures["max_level"]).max(axis=1) > 30)


shares = np.array([share_above(ramp) for ramp in ramps])

# %%
fig, ax = plt.subplots(figsize=(6, 2.8), layout="constrained")
ax.plot(ramps, 100 * shares, "o-", color=TUNED, label="published gains")
cannot = tuning.feasibility(case, mends=False).infeasible_for_any_controller
ax.axhline(100 * cannot, color=RIM, label="setpoints that no controller can hold")
ax.set(xlabel="time of a ramp [s]", ylabel="plants above a rim [%]", ylim=(0, 105))
ax.legend(loc="lower right");

# %% [markdown]
# With ramps of 120 s, {{200 * shares[-1]:.0f}} of the 200 plants still pass a rim. However slow the ramps, the
# share cannot fall below the line: on {{100 * cannot:.0f}} % of the plants the setpoints themselves are above what the
# rims allow. At rest at 16 and 10 cm, tank 3 of the nominal plant stands at
# {{(rest := jaxtank.analysis.equilibrium(case.loop.plant, (16.0, 10.0))[0])[2]:.1f}} cm. The level above an
# orifice grows with the square of the flow through it: if the lower outlets pass 5 % more and the
# upper ones 5 % less,
#
# $$h_3 = \left(\frac{1.05}{0.95}\right)^2 \cdot {{rest[2]:.2f}}\ \mathrm{cm}
#   = {{rest[2] * (1.05 / 0.95) ** 2:.1f}}\ \mathrm{cm},$$
#
# above the rim, under any controller, at any speed.

# %% [markdown]
# ## Conclusion
#
# - The gain $k_1$ trades error for height: from 0.03 to 1 1/s the error falls from {{error[0]:.2f}} to
#   {{error[-1]:.2f}} cm, and tank 4 rises from {{level[0]:.1f}} to {{level[-1]:.1f}} cm.
# - The published gain passes a rim on the nominal plant and on
#   {{100 * np.mean(before.measures["max_level"].max(axis=1) > 30):.1f}} % of 200 plants within 5 %.
# - Ramps of 120 s keep {{200 * (1 - shares[-1]):.0f}} of 200 plants below their rims. On
#   {{100 * cannot:.0f}} % of the plants no controller can, at any speed: a setpoint needs a level above a rim. What can be done is in notebook 03 (what a
#   limit costs) and notebook 04 (a filter under which no level passes its rim).
#
# ## Exercises
#
# **1.** With the published gains, what do 10 % more $k$ change, and what does ten times $k$?
#
# <details><summary>Answer</summary>
#
# 10 % more change the error from {{published["rms_error_total"]:.3f}} to
# {{(at := lambda k: jaxtank.evaluate(jaxtank.with_values(case.loop, {"controller.k": k}), case.clock, names))(0.033)["rms_error_total"]:.3f}} cm, ten times as much to
# {{at(0.3)["rms_error_total"]:.3f}} cm. The inflow is then reached three times faster, since
# $k + k_1$ is 0.388 in place of 0.118 1/s. A derivative is right for a small step; it does not say
# what a large one does. Notebook 02 is about that.
# </details>
#
# **2.** Switch the overflow on: `jaxtank.rig.set_values(case, {"plant.overflow": True})`. How much is
# lost over the rims of the nominal plant (measure `overflow_volume`)?
#
# <details><summary>Answer</summary>
#
# {{float(np.sum(jaxtank.evaluate((spills := jaxtank.rig.set_values(case, {"plant.overflow": True})).loop, case.clock, ["overflow_volume"])["overflow_volume"])):.0f}} cm³
# with the published gains.
# </details>
#
# **3.** How high must the rims be, so that 95 % of the 200 plants stay below them with $k_1$ = 0.17
# 1/s? (`after.measures["max_level"]` has a row for each plant.)
#
# <details><summary>Answer</summary>
#
# {{np.quantile(after.measures["max_level"].max(axis=1), 0.95):.1f}} cm: the 95th percentile of the highest
# level of any tank.
# </details>
