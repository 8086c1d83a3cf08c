"""An interactive view of a scene; results that a change does not affect are reused.
`Page` shows it in a browser, by viser
(the extra `studio`), and `widget` in a cell of a notebook (the extra `notebooks`).
"""

from ._controls import Controls as Controls, turned as turned
from ._notebook import widget as widget
from ._page import Page as Page
from ._saving import AsFile as AsFile, save as save
from ._search import Search as Search
from ._session import Session as Session
