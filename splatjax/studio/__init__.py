"""A scene seen live: what a change does not touch is kept. `Page` shows it in a browser, by viser
(the extra `studio`), and in a cell of a notebook.
"""

from ._controls import Controls as Controls, turned as turned
from ._page import check_viser as check_viser, Page as Page
from ._saving import AsFile as AsFile, save as save
from ._search import Search as Search
from ._session import Session as Session
