"""The avatar as a web page: data file, page and player (docs/web.md)."""
