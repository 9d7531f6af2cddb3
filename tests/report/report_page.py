"""Reading of a report as a browser without scripts would."""

import json
from html.parser import HTMLParser


class Page(HTMLParser):
    def __init__(self, text):
        super().__init__()
        self.tags, self.links, self.plots, self.text, self._inside = [], [], [], "", None
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        attributes = dict(attributes)
        self.tags.append((tag, attributes))
        self.links += [attributes[k] for k in ("src", "href") if attributes.get(k)]
        self._inside = attributes.get("data-plot", "") if tag == "script" else None

    def handle_endtag(self, tag):
        self._inside = None

    def handle_data(self, data):
        if self._inside:
            self.plots.append(json.loads(data))
        elif self._inside is None:
            self.text += data
