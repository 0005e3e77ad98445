"""A page as a browser would read it, for tests: every element closed in order, nothing that runs or is embedded."""

from html.parser import HTMLParser


class Page(HTMLParser):
    """`words` outside of style sheets, and `links`, of a whole page or of a part of one."""

    VOID = frozenset({"meta", "img", "br", "line"})

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open, self.words, self.links = [], [], []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        assert tag not in ("script", "link", "iframe", "object", "base")
        assert not any(name.startswith("on") for name, _ in attrs)
        self.links += [value or "" for name, value in attrs if name in ("src", "href")]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        if tag not in self.VOID:
            assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] != "style":
            self.words += data.split()
