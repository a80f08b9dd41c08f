"""Pictures of the viewer's page, which a headless Chromium draws through Playwright.

Nothing is served: the browser's requests are answered within this process.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import resources
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qsl, urlsplit

from caviar_protocol.errors import CaviarError, RunError, SetupError, one_line
from caviar_protocol.host import install_command

if TYPE_CHECKING:
    from caviar_view.answers import Answers

# Without these Chromium asks hosts of its vendor at every start.
FLAGS = ("--no-first-run", "--disable-background-networking", "--disable-component-update", "--disable-sync")
_ADDRESS = "http://page.invalid/view/"
# A processor that draws large pictures with shadows takes seconds for one.
_TIMEOUT_MS = 120_000


def fragment(link: str) -> str:
    """Part of a link to the page that says what is seen.

    Example:
        >>> fragment("http://127.0.0.1:8100/view/#n=7&cam=0,0,9,5,5,0"), fragment("#panel=0"), fragment("")
        ('n=7&cam=0,0,9,5,5,0', 'panel=0', '')
    """
    return link.rpartition("#")[2] if "#" in link or "=" in link else ""


@contextmanager
def opened_page(
    answers: Answers, link: str, size: tuple[int, int]
) -> Iterator[Callable[[int | None], bytes]]:
    """Open the page, and yield a function from a place to its picture as PNG; None: where the link leads.

    Args:
        answers: About the frames that are shown.
        link: To the page, or its part from ``#`` on: camera, layers, user and all else.
        size: Width and height [pixels].

    Raises:
        SetupError: Playwright or Chromium is not installed; the text has the command.
        RunError: The page cannot show something; the text has its reason.
    """
    try:
        from playwright.sync_api import Error, sync_playwright
    except ModuleNotFoundError:
        need = "pictures of the page need Playwright"
        raise SetupError(f"{need}, which is not installed; run: {install_command('film')}") from None
    folder = resources.files("caviar_view") / "page"

    def answer(route: Any) -> None:
        url = urlsplit(route.request.url)
        name = url.path.removeprefix("/view/") or "index.html"
        try:
            if name.startswith("data/"):
                found = answers.get(name.removeprefix("data/"), dict(parse_qsl(url.query)))
                route.fulfill(body=found.content, content_type=found.media_type)
            else:
                kinds = {"html": "text/html; charset=utf-8", "js": "text/javascript", "css": "text/css"}
                kind = kinds[name.rpartition(".")[2]]
                route.fulfill(body=(folder / name).read_bytes(), content_type=kind)
        except CaviarError as error:
            route.fulfill(status=404, json={"detail": str(error)})
        except (KeyError, OSError):
            route.fulfill(status=404, body="")

    try:
        with sync_playwright() as drivers:
            try:
                browser = drivers.chromium.launch(executable_path=shutil.which("chromium"), args=FLAGS)
            except Error as error:
                raise SetupError(
                    f"Chromium does not start: {one_line(error.message)[:200]}; run: "
                    "apt-get install chromium (or: python -m playwright install chromium)"
                ) from None
            width, height = size
            page = browser.new_page(viewport={"width": width, "height": height})
            page.set_default_timeout(_TIMEOUT_MS)
            page.route("**/*", answer)
            page.goto(f"{_ADDRESS}#{fragment(link)}")

            def picture(place: int | None) -> bytes:
                page.evaluate("n => n === null ? caviar.ready : caviar.go(n)", place)
                if errors := page.evaluate("caviar.state().errors"):
                    raise RunError(f"the page cannot show all: {errors[0]}")
                return page.screenshot()

            yield picture
            page.unroute_all(behavior="wait")  # trails are still being loaded
    except Error as error:
        raise RunError(f"the page cannot be drawn: {one_line(error.message)}") from error
