"""What a person does in the page arrives, as Chromium sends it."""

import pytest

from tests.scenery import chromium
from tests.view.conftest import comes

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(chromium.PROGRAM is None, reason="Chromium is not installed"),
]


def test_every_control_of_the_page_and_a_click_into_the_scene_are_taken(served, tmp_path):
    viewer = served.viewer
    # viser gives the elements of a control its number.
    box, by = (
        f"document.getElementById('{one._impl.uuid}')" for one in (viewer._layers[0][0], viewer._by)
    )
    height = "[...document.querySelectorAll('[role=option]')].find(o => o.innerText == 'height')"
    with chromium.opened(tmp_path) as page:
        page.open(served.url)
        assert comes(page, lambda: viewer.looked_at and page.run(f"!!{box} && !!{by}"))
        page.run(f"{box}.click()")
        assert comes(page, lambda: not viewer._layers[0][1].visible)
        page.run(f"{box}.click()")
        assert comes(page, lambda: viewer._layers[0][1].visible)
        page.run(f"{by}.click()")
        assert comes(page, lambda: page.run(f"!!{height}"))
        page.run(f"{height}.click()")
        assert comes(page, lambda: "blue to red" in viewer._legend.content)
        page.run("[...document.querySelectorAll('[role=slider]')].pop().focus()")
        page.press("ArrowRight")
        assert comes(page, lambda: "keyframe 1" in viewer._said.content)
        # Into the cloud, beside the panel.
        wide, high = page.run("[innerWidth, innerHeight]")
        assert comes(
            page,
            lambda: page.click(0.4 * wide, 0.6 * high) or "keyframe 0" in viewer._said.content,
        )
        page.run(f"document.getElementById('{viewer._tool._impl.uuid}').click()")
        area = height.replace("'height'", "'area'")
        assert comes(page, lambda: page.run(f"!!{area}"))
        page.run(f"{area}.click()")
        assert comes(page, lambda: viewer._tool.value == "area")
        for across, down in ((0.4, 0.6), (0.45, 0.6), (0.45, 0.65)):
            before = len(viewer._places)
            page.click(across * wide, down * high)
            assert comes(page, lambda before=before: len(viewer._places) > before)
        shown = "document.body.innerText.includes('seen from above: 0.')"
        assert comes(page, lambda: page.run(shown))
        clear = "[...document.querySelectorAll('button')].find(o => o.innerText.includes('Clear'))"
        page.run(f"{clear}.click()")
        assert comes(page, lambda: not page.run(shown))
        assert page.errors == []
