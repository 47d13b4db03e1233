"""A rig of many tanks and gains, for tests and benchmarks."""


def rig_text(tanks):
    """A rig file: a row of tanks joined by orifices, each with a pump under a PI of its own."""
    numbers = range(tanks)
    changes = [[3.0 + i // 6, i + 1, 5.4 + 0.2 * (i % 2)] for i in numbers]
    tank = "[[tank]]\narea = {}\nlevel = 5.0\nrim = 20.0\ndrain = 0.1"
    orifice = "[[orifice]]\nfrom = {}\nto = {}\narea = 0.02"
    pump = "[[pump]]\nto = {}\ngain = 5.0\nhigh = 12.0\ninitial = 1.98"
    return "\n".join(
        [
            f'name = "{tanks} tanks in a row"',
            *(tank.format(20 + i % 3) for i in numbers),
            *(orifice.format(i, i + 1) for i in numbers[1:]),
            *(pump.format(i + 1) for i in numbers),
            f"[plant]\noutputs = {[i + 1 for i in numbers]}",
            f'[controller]\nkind = "pid"\nKc = {[1 + 0.01 * i for i in numbers]}',
            f"Ti = {[20 + 0.1 * i for i in numbers]}",
            f"[reference]\ninitial = {[5.0] * tanks}\nramp = 3.0\nchanges = {changes}",
            '[values]\n"clock.dt" = 1.0\n"clock.duration" = 40.0',
            '[free]\n"controller.Kc" = [0.2, 8.0]\n"controller.Ti" = [5.0, 200.0]',
        ]
    )
