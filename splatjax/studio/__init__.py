"""An interactive view of a scene that reuses all results that a change does not affect. `Page`
shows it in a browser with viser (the extra `studio`), and `widget` in a notebook cell (the extra
`notebooks`).
"""

from ._controls import Controls as Controls, turned as turned
from ._notebook import widget as widget
from ._page import Page as Page
from ._saving import AsFile as AsFile, save as save
from ._search import Search as Search
from ._session import Session as Session
