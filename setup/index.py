"""Finds a file on the user's package index, as pip would: same address, proxy and certificates.

No index address is written here. pip's configuration says which one to use (configuration files and
PIP_* variables, both shown by `pip config list`), and pip's built-in default fills the gap.
"""

import ast
import base64
import functools
import json
import netrc
import os
import re
import ssl
import subprocess
import sys
import urllib.error
import urllib.parse
import urllib.request
from html.parser import HTMLParser
from typing import Dict, List, NamedTuple, Optional, Tuple

from common import NetworkError, PipError

ACCEPT = "application/vnd.pypi.simple.v1+json, application/vnd.pypi.simple.v1+html;q=0.2, text/html;q=0.1"
INDEX_PAGE_BYTES_MAX = 64 << 20
FINAL_HTTP_CODES = (401, 403, 404, 410)

# Run in a process of its own: pip's internals may print, or be missing.
_ASK_PIP = """
import json
out = {}
try:
    from pip._internal.models.index import PyPI
    out["default"] = PyPI.simple_url
except Exception as error:
    out["default_error"] = str(error)
try:
    from pip._vendor import certifi
    out["certifi"] = certifi.where()
except Exception:
    pass
print(json.dumps(out))
"""


class NotListed(NetworkError):
    """Every index answered, and none has the file: asking again would not help."""


class PipSettings(NamedTuple):
    index_urls: Tuple[str, ...]
    cert: Optional[str]
    client_cert: Optional[str]
    certifi: Optional[str]
    proxy: Optional[str]
    trusted_hosts: Tuple[str, ...]
    timeout_secs: float


class Link(NamedTuple):
    url: str
    sha256: Optional[str]  # what the index says; the pin decides


@functools.lru_cache(maxsize=None)  # two processes of pip per answer, and it does not change during a run
def pip_settings(python: str = sys.executable) -> PipSettings:
    listed = _run(python, "-m", "pip", "config", "list")
    asked = json.loads(_run(python, "-c", _ASK_PIP).strip().splitlines()[-1])
    options = parse_pip_config(listed)
    urls: List[str] = []
    if "no-index" not in options:
        urls = [options.get("index-url") or asked.get("default", "")] + options.get("extra-index-url", "").split()
    return PipSettings(
        index_urls=tuple(url.rstrip("/") for url in urls if url),
        cert=options.get("cert") or os.environ.get("REQUESTS_CA_BUNDLE"),
        client_cert=options.get("client-cert"),
        certifi=asked.get("certifi"),
        proxy=options.get("proxy"),
        trusted_hosts=tuple(options.get("trusted-host", "").split()),
        # Capped, because a download that stalls is continued anyway.
        timeout_secs=min(float(options.get("timeout") or options.get("default-timeout") or 30), 60.0),
    )


def parse_pip_config(listed: str) -> Dict[str, str]:
    """Merges the lines `section.key='value'` of `pip config list` as `pip download` would."""
    rank = {"global": 1, "download": 2, ":env:": 3}
    best: Dict[str, Tuple[int, str]] = {}
    for line in listed.splitlines():
        match = re.match(r"^(global|download|:env:)\.([\w-]+)=(.*)$", line.strip())
        if not match:
            continue
        section, key, raw = match.groups()
        try:
            value = str(ast.literal_eval(raw))
        except (SyntaxError, ValueError):
            value = raw
        if value and rank[section] >= best.get(key, (0, ""))[0]:
            best[key] = (rank[section], value)
    options = {key: value for key, (_, value) in best.items()}
    if options.get("no-index", "0").lower() in ("0", "false", "no", "off"):
        options.pop("no-index", None)
    return options


class Client:
    """HTTP with pip's certificates and proxy. Stateless, so nothing to close."""

    def __init__(self, settings: PipSettings):
        self.settings = settings
        proxies = {"http": settings.proxy, "https": settings.proxy} if settings.proxy else None
        self._proxy_handler = urllib.request.ProxyHandler(proxies)
        self._opener = self._build(self._ssl_context())
        self._unverified = self._build(ssl._create_unverified_context())

    def _build(self, context: ssl.SSLContext) -> urllib.request.OpenerDirector:
        return urllib.request.build_opener(self._proxy_handler, urllib.request.HTTPSHandler(context=context))

    def _ssl_context(self) -> ssl.SSLContext:
        try:
            context = ssl.create_default_context(cafile=self.settings.cert)
            if not self.settings.cert and self.settings.certifi:
                context.load_verify_locations(cafile=self.settings.certifi)
            if self.settings.client_cert:
                context.load_cert_chain(self.settings.client_cert)
        except (OSError, ssl.SSLError) as error:
            raise NetworkError(
                "cannot read the certificates that pip is configured with (%s): correct `cert` in pip's configuration"
                % error
            )
        return context

    def open(self, url: str, headers: Optional[Dict[str, str]] = None):
        plain, authorization = split_credentials(url)
        request = urllib.request.Request(plain, headers=dict(headers or {}))
        request.add_header("User-Agent", "caudata-setup")
        if authorization:
            # Unredirected: a redirect to another host must not receive the password.
            request.add_unredirected_header("Authorization", authorization)
        parts = urllib.parse.urlsplit(plain)
        trusted = parts.hostname in self.settings.trusted_hosts or parts.netloc in self.settings.trusted_hosts
        opener = self._unverified if trusted else self._opener
        return opener.open(request, timeout=self.settings.timeout_secs)


def find_file(client: Client, project: str, filename: str, sha256: str) -> Link:
    """The address of one exact file, from the first configured index that lists it."""
    reasons = []
    unreachable = False
    for index_url in client.settings.index_urls:
        page_url = "%s/%s/" % (index_url, project)
        shown = without_credentials(page_url)
        try:
            link = _links_of(client, page_url).get(filename)
        except (OSError, ValueError, KeyError) as error:  # URLError, timeouts and TLS errors are OSErrors
            unreachable = unreachable or getattr(error, "code", None) not in FINAL_HTTP_CODES
            reasons.append("%s: %s" % (shown, error))
            continue
        if link is None:
            reasons.append("%s does not list %s" % (shown, filename))
        elif link.sha256 and link.sha256 != sha256:
            reasons.append("%s lists another hash for %s" % (shown, filename))
        else:
            return link
    kind = NetworkError if unreachable else NotListed
    raise kind("; ".join(reasons) or "pip is configured with no index")


def _links_of(client: Client, page_url: str) -> Dict[str, Link]:
    with client.open(page_url, {"Accept": ACCEPT}) as response:
        body = response.read(INDEX_PAGE_BYTES_MAX)
        base = response.geturl()
        if "json" in (response.headers.get("Content-Type") or ""):
            links = links_from_json(body, base)
        else:
            links = links_from_html(body, base)
    return {name: _carry_credentials(link, page_url) for name, link in links.items()}


def links_from_json(body: bytes, base: str) -> Dict[str, Link]:
    files = json.loads(body.decode("utf-8"))["files"]
    return {
        f["filename"]: Link(urllib.parse.urljoin(base, f["url"]), f.get("hashes", {}).get("sha256")) for f in files
    }


def links_from_html(body: bytes, base: str) -> Dict[str, Link]:
    parser = _Anchors(base)
    parser.feed(body.decode("utf-8", "replace"))
    links = {}
    for href in parser.hrefs:
        url, fragment = urllib.parse.urldefrag(urllib.parse.urljoin(parser.base, href))
        filename = urllib.parse.unquote(urllib.parse.urlsplit(url).path.rsplit("/", 1)[-1])
        sha256 = urllib.parse.parse_qs(fragment).get("sha256", [None])[0]
        links[filename] = Link(url, sha256)
    return links


class _Anchors(HTMLParser):
    def __init__(self, base: str):
        super().__init__()
        self.base = base
        self.hrefs: List[str] = []

    def handle_starttag(self, tag, attrs):
        href = dict(attrs).get("href")
        if href and tag == "base":
            self.base = urllib.parse.urljoin(self.base, href)
        elif href and tag == "a":
            self.hrefs.append(href)


def _carry_credentials(link: Link, page_url: str) -> Link:
    """A private index often serves its files from the same host under the same password."""
    page, target = urllib.parse.urlsplit(page_url), urllib.parse.urlsplit(link.url)
    same_place = (page.scheme, page.hostname, page.port) == (target.scheme, target.hostname, target.port)
    if "@" not in page.netloc or "@" in target.netloc or not same_place:
        return link
    return link._replace(url=urllib.parse.urlunsplit(target._replace(netloc=page.netloc)))


def split_credentials(url: str) -> Tuple[str, Optional[str]]:
    """Takes `user:password@` out of an address, or looks the host up in ~/.netrc, as pip does."""
    parts = urllib.parse.urlsplit(url)
    userinfo, _, host = parts.netloc.rpartition("@")
    user, _, password = userinfo.partition(":")
    if not userinfo:
        try:
            found = netrc.netrc().authenticators(parts.hostname or "")
        except (OSError, netrc.NetrcParseError):
            found = None
        if not found:
            return url, None
        user, password = found[0], found[2] or ""
    token = "%s:%s" % (urllib.parse.unquote(user), urllib.parse.unquote(password))
    plain = urllib.parse.urlunsplit(parts._replace(netloc=host))
    return plain, "Basic " + base64.b64encode(token.encode("utf-8")).decode("ascii")


def without_credentials(url: str) -> str:
    parts = urllib.parse.urlsplit(url)
    return urllib.parse.urlunsplit(parts._replace(netloc=parts.netloc.rpartition("@")[2]))


def _run(*command: str) -> str:
    try:
        done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, timeout=120)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise PipError("cannot ask pip for its configuration (%s): install pip for %s" % (error, command[0]))
    if done.returncode != 0:
        last = (done.stderr.decode("utf-8", "replace").strip().splitlines() or ["no message"])[-1]
        raise PipError(
            "cannot ask pip for its configuration (%s): install pip for %s, on Debian with"
            " `apt install python3-pip`" % (last, command[0])
        )
    return done.stdout.decode("utf-8", "replace")
