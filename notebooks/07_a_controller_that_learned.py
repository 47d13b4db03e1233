# %% [markdown]
# # A controller that learned
#
# **Question:** Can a small neural network, trained through the simulation, follow setpoints better
# than the controllers of a paper, and never pass a limit, not even before it has learned anything?
#
# The rig and its rivals: H. Gouta, S. Hadj Said, F. M'sahli, *Model-based predictive and backstepping
# controllers for a state coupled four-tank system with bounded control inputs*, J. Franklin Inst. 352
# (2015) 4864, [doi:10.1016/j.jfranklin.2015.08.004](https://doi.org/10.1016/j.jfranklin.2015.08.004).
#
# Run time: about {{run_time}} s. {{links}}

# %%
import dataclasses

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import optax

import jaxtank
import tuning
from jaxtank import component, leaf, presets
from jaxtank.controllers.base import Controller
from jaxtank.plots.responses import responses

jaxtank.notebook()

# %% [markdown]
# ## A network that controls
#
# The network sees eight numbers $s$ at each sample: the two errors $r - h$, the two setpoints and
# their rates, and the levels of the two upper tanks. One hidden layer of 16 units turns them into two
# voltages:
#
# $$u = W_2 \tanh(W_1 s + b_1) + b_2.$$
#
# To the package this is a controller like any other: a class with numbers (`leaf`) and a `step`, which
# returns the voltages and the next state (here there is none).

# %%
SCALE = np.array([1, 1, 0.1, 0.1, 10, 10, 0.05, 0.05])  # so that all are about 1


@component
class Network(Controller):
    w1: np.ndarray = leaf("-", "weights", shape=(16, 8))
    b1: np.ndarray = leaf("-", "offsets", shape=(16,))
    w2: np.ndarray = leaf("V", "weights", shape=(2, 16))
    b2: np.ndarray = leaf("V", "offsets", shape=(2,))

    def step(self, state, tick, estimate):
        error = [r - h for r, h in zip(tick.r, estimate.x)]
        seen = SCALE * jnp.stack([*error, *tick.r, *tick.dr, *estimate.x[2:]])
        return tuple(self.w2 @ jnp.tanh(self.w1 @ seen + self.b1) + self.b2), state


# %% [markdown]
# The rig is that of the paper, with samples of 1 s, under the safety filter. The filter knows the
# tolerances of the rig (every flow within 5 %) and caps the pumps so that no level passes its rim of
# 30 cm. It does not ask what the controller is. The weights are random.

# %%
paper = {
    name: jaxtank.rig.set_values(presets.find(f"gouta2015/{name}"), {"clock.dt": 1.0})
    for name in ("backstepping", "ngpc", "ngpc-observer")
}
safe = {name: case.with_safety_filter() for name, case in paper.items()}
rng, base = np.random.default_rng(0), safe["backstepping"]
w1, w2 = 0.4 * rng.normal(size=(16, 8)), 0.4 * rng.normal(size=(2, 16))
network = Network(w1=w1, b1=np.zeros(16), w2=w2, b2=np.array([7.0, 7.0]))
newborn = base.replace(loop=dataclasses.replace(base.loop, controller=network))

# %% [markdown]
# **Guess first:** random weights, 256 plants, noise in the readings. On how many plants does a tank
# overflow?

# %%
found = {"untrained network": tuning.validate(newborn)}
unsafe = tuning.validate(newborn.without_safety_filter())
run = jaxtank.simulate(newborn.loop, newborn.clock)
figure = responses(newborn.loop, {"untrained network": run}, "random weights, under the filter")

# %% [markdown]
# With the filter on {{np.sum(~found["untrained network"].held)}} of {{found["untrained network"].samples}} plants; without
# it on {{np.sum(~unsafe.held)}}. The levels do not follow (the mean error is
# {{np.mean(found["untrained network"].error):.0f}} cm), and tank 4 stops just below its rim.
# The proof does not ask for the weights, so that no plant within the tolerances overflows while the network
# learns.
#
# ## Learning
#
# The cost of one plant is the mean squared error plus a price on the change of the voltages from sample
# to sample,
#
# $$J = \sum_i \overline{e_i^2} + 0.2\,\sum_j \overline{\Delta u_j^2},$$
#
# averaged over 64 plants within the tolerances. Its gradient with respect to all weights is exact, and
# goes back through 1,201 samples of controller, filter, pumps and tanks.

# %%
plant = base.loop.plant
flows = {f"plant.{name}": getattr(plant, name) for name in ("drain", "orifice", "pump_gain")}
plants = {name: v * rng.uniform(0.95, 1.05, (64, v.size)) for name, v in flows.items()}


def cost(weights, plants, loop=newborn.loop):
    def of_one(plant):
        own = jaxtank.with_values(loop, weights | plant)
        v = jaxtank.evaluate(own, base.clock, ["mean_square_error", "mean_square_travel"])
        return jnp.sum(v["mean_square_error"]) + 0.2 * jnp.sum(v["mean_square_travel"])

    return jnp.mean(jax.vmap(of_one)(plants))


# %% [markdown]
# The rest is optax: Adam with a decreasing step.

# %%
STEPS = 70
weights = {f"controller.{name}": getattr(network, name) for name in ("w1", "b1", "w2", "b2")}
adam = optax.chain(
    optax.clip_by_global_norm(1.0), optax.adam(optax.cosine_decay_schedule(0.03, STEPS, 0.02))
)
memory, slope, history = adam.init(weights), jax.jit(jax.value_and_grad(cost)), []
for _ in range(STEPS):
    value, gradient = slope(weights, plants)
    change, memory = adam.update(gradient, memory)
    weights = optax.apply_updates(weights, change)
    history.append(float(value))

# %% [markdown]
# **Guess first:** after how many of the 70 steps is the network better than the predictive controller
# of the paper on the same 64 plants?

# %%
rivals = {n: float(jax.jit(cost)({}, plants, safe[n].loop)) for n in ("backstepping", "ngpc")}
figure, ax = plt.subplots(figsize=(8, 3.4), layout="constrained")
ax.semilogy(np.sqrt(history), label="network")
for k, (name, value) in enumerate(rivals.items()):
    ax.axhline(np.sqrt(value), linestyle="--", color=f"C{k + 1}", label=name)
ax.set(xlabel="step of the training [-]", ylabel="root of the cost", ylim=(0.2, 20.0))
legend = figure.legend(loc="outside right center")

# %% [markdown]
# After {{int(np.argmax(np.array(history) < rivals["ngpc"]))}} steps. Backstepping is overtaken after
# {{int(np.argmax(np.array(history) < rivals["backstepping"]))}}.
#
# ## The test
#
# 256 other plants, and now the readings have noise; the network was trained without it. All controllers
# have the same safety filter.
#
# The horizon $T_p$ of the predictive controller, 11 s in the paper, was not chosen for these plants. So
# it is varied, with and without the observer; backstepping has the gains of the paper, and the fast ones of
# notebook 03. A small error
# often needs much motion of the pumps, so the figure has both: to the left the pumps move little, below
# the tracking is good.
#
# **Guess first:** will the network lie below the line of `ngpc`, on it, or above?

# %%
trained = newborn.replace(name="network", loop=jaxtank.with_values(newborn.loop, weights))
found |= {"network": tuning.validate(trained), "backstepping": tuning.validate(base)}
fast = jaxtank.with_values(base.loop, {"controller.k": 1.34, "controller.k1": 1.79})  # 1/s
found["backstepping, fast gains"] = tuning.validate(base.replace(loop=fast))


def judged(name, Tp):
    loop = jaxtank.with_values(safe[name].loop, {"controller.Tp": Tp})
    return tuning.validate(safe[name].replace(loop=loop))


horizons = (4.0, 6.5, 11.0, 20.0)  # s
sweep = {name: [judged(name, Tp) for Tp in horizons] for name in ("ngpc", "ngpc-observer")}
found |= {name: row[horizons.index(11.0)] for name, row in sweep.items()}

# %% tags=["thumbnail"]
error, moves = lambda j: np.mean(j.error), lambda j: 100 * np.mean(j.travel)
figure, ax = plt.subplots(figsize=(7.5, 3.8), layout="constrained")
for name, row in sweep.items():
    ax.plot([moves(j) for j in row], [error(j) for j in row], "o-", label=f"{name}, Tp 4 to 20 s")
for name in ("backstepping", "backstepping, fast gains", "network"):
    ax.plot(moves(found[name]), error(found[name]), "D", markersize=9, label=name)
ax.set(xscale="log", ylabel="mean error [cm]", title="256 plants under the same safety filter")
ax.set_xlabel("rms change of the inputs per sample [% of their range]")
legend = ax.legend()

# %% [markdown]
# - As printed (Tp = 11 s), `ngpc` has {{error(found["ngpc"]):.2f}} cm and moves its pumps by
#   {{moves(found["ngpc"]):.1f}} % per sample. The network has {{error(found["network"]):.2f}} cm with
#   {{moves(found["network"]):.1f}} %, backstepping {{error(found["backstepping"]):.2f}} cm with
#   {{moves(found["backstepping"]):.1f}} %. The network lies below the line of `ngpc`.
# - Backstepping with fast gains has {{error(found["backstepping, fast gains"]):.2f}} cm and moves its pumps by
#   {{moves(found["backstepping, fast gains"]):.0f}} %: with noise in the readings such gains are of little use.
# - With a horizon of 4 s `ngpc` reaches {{error(sweep["ngpc"][0]):.2f}} cm, but needs
#   {{moves(sweep["ngpc"][0]):.0f}} %: a short horizon amplifies the noise.
# - With an observer the error is {{error(found["ngpc-observer"]):.2f}} cm at
#   {{moves(found["ngpc-observer"]):.1f}} %, and with Tp = 20 s {{error(sweep["ngpc-observer"][-1]):.2f}} cm at
#   {{moves(sweep["ngpc-observer"][-1]):.1f}} %, nearly as good as the network by both measures.
# - The limits held on {{100 * min(np.mean(j.held) for row in sweep.values() for j in row):.0f}} % of the
#   plants at every point of the lines, and on {{100 * np.mean(found["network"].held):.0f}} % with the network.
#
# ## Setpoints that it has never seen
#
# The paper's controllers contain a model of the rig. The network has seen one sequence of setpoints, on
# 64 plants: that of the paper. Now the setpoints are other pairs of levels, all of which the rig can hold,
# in ramps of 20 s instead of 60 s.
#
# **Guess first:** who is better now, the network or `ngpc` without an observer?

# %%
changes = [(20, 0, 12.0), (20, 1, 12.0), (300, 1, 9.0), (600, 1, 14.0), (900, 0, 10.0)]
other = jaxtank.signals.ramps([3.0, 3.0], changes, ramp=20.0)
new = {
    name: case.replace(loop=dataclasses.replace(case.loop, reference=other))
    for name, case in {"ngpc": safe["ngpc"], "network": trained}.items()
}
unseen = {name: tuning.validate(case) for name, case in new.items()}

# %%
runs = {name: jaxtank.simulate(new[name].loop, base.clock) for name in ("ngpc", "network")}
rms = lambda run: float(np.sqrt(np.sum(np.mean(run.e**2, axis=0))))  # cm
figure, axes = plt.subplots(1, 2, figsize=(9, 3.2), layout="constrained", sharey=True)
for tank, ax in enumerate(axes):
    for name, run in runs.items():
        ax.plot(run.t, run.x[:, tank], label=name if tank else None)
    ax.plot(run.t, run.r[:, tank], ":", color="black", label="setpoint" if tank else None)
    ax.set(title=f"tank {tank + 1}", xlabel="time [s]")
legend = figure.legend(loc="outside lower center", ncols=3), axes[0].set_ylabel("level [cm]")

# %% [markdown]
# On the nominal plant of the figure the network oscillates after ramps that it does not know, and keeps
# small offsets:
# {{rms(runs["network"]):.2f}} cm, and {{rms(runs["ngpc"]):.2f}} cm with the predictive controller. On the 256 plants
# the network has {{error(unseen["network"]):.2f}} cm, and the predictive controller
# {{error(unseen["ngpc"]):.2f}} cm: without an observer a wrong model leaves offsets. The limits hold on
# {{100 * unseen["network"].share_held()["share"]:.0f}} % of the plants: the filter does not depend on what the
# network has seen.
#
# ## Wear
#
# The gain of pump 1 may fall far out of the 5 % of the training and of the proof. In the figure of 64 plants the
# pump has lost 20 %.

# %%
gain = float(plant.pump_gain[0])
weaker = jaxtank.with_values(trained.loop, {"plant.pump_gain[0]": 0.8 * gain})
worn_pump = trained.replace(loop=weaker)
sound, worn = (tuning.ensemble(c, samples=64) for c in (trained, worn_pump))
figures = worn.plot()
[plt.close(figure) for name, figure in figures.items() if name != "fan"];

# %% [markdown]
# The mean error of the 64 plants is {{np.mean(worn.measures["rms_error_total"]):.2f}} cm, with the nominal gain
# {{np.mean(sound.measures["rms_error_total"]):.2f}} cm, and {{100 * np.mean(np.any(worn.measures["max_level"] > 30.0, axis=1)):.0f}} % of them rise above a rim.
# The proof ends with pumps that are stronger than the filter assumes.
#
# ## Conclusion
#
# - A controller of your own is a class with a `step`. 64 plants, {{STEPS}} steps and the exact gradient
#   through the whole loop train {{sum(np.size(w) for w in weights.values())}} weights in seconds.
# - The safety filter needs no trust in the controller: with random weights a limit was violated on
#   {{np.sum(~found["untrained network"].held)}} of 256 plants, without it on {{np.sum(~unsafe.held)}}.
# - On the setpoints of its training the network is better than both printed controllers ({{error(found["network"]):.2f}} cm against
#   {{error(found["ngpc"]):.2f}} and {{error(found["backstepping"]):.2f}} cm). A shorter horizon gives
#   nearly the same error with {{moves(sweep["ngpc"][0]) / moves(found["network"]):.1f}} times the motion of
#   the pumps, an observer a smaller one.
# - On setpoints that it had never seen the network is better on the mean of the plants
#   ({{error(unseen["network"]):.2f}} against {{error(unseen["ngpc"]):.2f}} cm), and worse on the nominal one
#   ({{rms(runs["network"]):.2f}} against {{rms(runs["ngpc"]):.2f}} cm), for which the controller of the paper has
#   the exact model.
#
# ## Exercises
#
# **1.** Give the network a memory: return the sums of the two errors as its state, and let it see them,
# scaled by 0.05 (a `w1` of 16 x 10). Is it better after the same 70 steps?
#
# <details><summary>Answer</summary>
#
# Hardly: 0.32 cm on the setpoints of the paper, as before, and 0.36 cm in place of 0.42 cm on the new ones
# (with random weights of ours; yours will differ a little).
# </details>
#
# **2.** Train without the filter (`loop=newborn.without_safety_filter().loop` in `cost`), and judge with
# and without it. What has the network learned?
#
# <details><summary>Answer</summary>
#
# To overflow. Without the filter it violates a limit on every one of the 256 plants, with an error of less
# than 0.2 cm: the limits are what makes the task difficult. Under the filter it is about as good as the
# network that was trained under it.
# </details>
#
# **3.** Give half of the plants the new setpoints `other` during the training. Does the network become
# better there, and what does it cost on the setpoints of the paper?
#
# <details><summary>Answer</summary>
#
# On the new setpoints it then has 0.28 cm in place of 0.42 cm, and on those of the paper 0.32 cm, as before.
# What a network is to know must be in its training.
# </details>
