"""A browser in forty lines: what a report shows, and what it would load."""

import re
from html.parser import HTMLParser

LOADING = ("src", "href", "srcset", "data", "poster", "action", "formaction", "background", "ping", "xlink:href")


class Reader(HTMLParser):
    """Elements, texts and addresses of a page."""

    def __init__(self, text):
        super().__init__()
        self.open, self.elements, self.texts, self.addresses = [], [], [], []
        self.feed(text)
        self.close()
        assert self.open == [], f"not closed: {self.open}"

    def handle_starttag(self, tag, attributes):
        attributes = dict(attributes)
        self.elements.append((tag, attributes))
        self.addresses += [value for name, value in attributes.items() if name in LOADING]
        self.addresses += re.findall(r"url\(([^)]*)\)|@import (\S+)", attributes.get("style") or "")
        if tag not in ("meta", "link", "img", "br"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] == "style":
            self.addresses += re.findall(r"url\(([^)]*)\)|@import (\S+)", data)
        elif self.open and self.open[-1] != "script":
            self.texts.append(" ".join(data.split()))

    @property
    def text(self):
        return " ".join(filter(None, self.texts))

    def all(self, tag, kind=None):
        """Attributes of all elements of a tag, and of a class."""
        found = [attributes for name, attributes in self.elements if name == tag]
        return found if kind is None else [each for each in found if kind in (each.get("class") or "").split()]
