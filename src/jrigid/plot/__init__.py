"""Pictures, drawn by matplotlib (`jrigid[plot]`).

Every function takes what the library returns, draws into the axes `ax` that it is
given, or into a new figure, and returns the axes. What was drawn is in their `lines`
and `collections`, and the figure is `ax.figure`. Pictures of several panels (`fit`,
`light_curves`, `motion`) take and return a dict of axes by their names. Pictures on a
sphere (`polhode`, `tip`, `body`) need axes of three dimensions,
`figure.add_subplot(projection="3d")`, whose view is not changed. Lines behind the
sphere are faint. `animate` and `animate_light_curve` return an `Animation`, to show in
a notebook or to save. Matplotlib is imported when the first picture is drawn.
"""

from jrigid._public import list_public_names as _list_public_names
from jrigid.plot._animate import Animation as Animation
from jrigid.plot._animate import animate as animate
from jrigid.plot._animate import animate_light_curve as animate_light_curve
from jrigid.plot._appearance import appearance as appearance
from jrigid.plot._body_pictures import body as body
from jrigid.plot._chart import chart as chart
from jrigid.plot._fit_pictures import fit as fit
from jrigid.plot._free import herpolhode as herpolhode
from jrigid.plot._free import polhode as polhode
from jrigid.plot._light import light_curves as light_curves
from jrigid.plot._light import period_map as period_map
from jrigid.plot._top import effective_potential as effective_potential
from jrigid.plot._top import tip as tip
from jrigid.plot._trajectory_pictures import motion as motion

_list_public_names(__name__)
