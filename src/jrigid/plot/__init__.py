"""Pictures, drawn by matplotlib, which is imported when the first is drawn (`jrigid[plot]`).

One convention: every function takes what the library returns, draws into the axes `ax`
that it is given, or into a new figure, and returns the axes; what was drawn is in their
`lines` and `collections`, the figure is `ax.figure`. Pictures of several panels (`fit`,
`motion`) take and return a dict of axes by their names. What is on a sphere (`polhode`,
`tip`, `body`) needs axes of three dimensions, `figure.add_subplot(projection="3d")`,
which keep the view they have; what lies behind is faint. `animate` returns an
`Animation`, to show in a notebook or to save.
"""

from jrigid.plot._animate import Animation as Animation
from jrigid.plot._animate import animate as animate
from jrigid.plot._body import body as body
from jrigid.plot._chart import chart as chart
from jrigid.plot._fit import fit as fit
from jrigid.plot._free import herpolhode as herpolhode
from jrigid.plot._free import polhode as polhode
from jrigid.plot._motion import motion as motion
from jrigid.plot._top import effective_potential as effective_potential
from jrigid.plot._top import tip as tip
