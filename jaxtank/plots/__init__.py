"""Pictures on given matplotlib axes; the only folder of this package that imports matplotlib.

`responses` (runs, searches, effects of parameters), `diagnostics`, `uncertainty`, `fit`,
`schematic` and `animation` draw; `equations` prints a rig's equations.
"""
