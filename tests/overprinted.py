"""Which texts of a picture lie on each other."""

from itertools import combinations

from matplotlib.text import Text


def overprinted(figure, least=2.0):
    """Pairs of texts, other than numbers along axes, that are drawn over each other by more than `least` pixels."""
    renderer = figure.canvas.get_renderer()
    figure.draw(renderer)
    rulers = [ruler for axes in figure.axes for ruler in (axes.xaxis, axes.yaxis)]
    ticks = {id(label) for ruler in rulers for label in ruler.get_ticklabels(which="both")}
    ticks |= {id(label) for ruler in rulers for tick in ruler.get_major_ticks() for label in (tick.label1, tick.label2)}
    seen = [text for text in figure.findobj(Text) if text.get_visible() and text.get_text().strip()]
    boxes = [(text.get_text(), text.get_window_extent(renderer)) for text in seen if id(text) not in ticks]
    return [
        (name, other)
        for (name, a), (other, b) in combinations(boxes, 2)
        if min(a.x1, b.x1) - max(a.x0, b.x0) > least and min(a.y1, b.y1) - max(a.y0, b.y0) > least
    ]
