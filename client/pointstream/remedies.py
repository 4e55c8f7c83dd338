"""What to write into the configuration of a host, so that it serves models as well as it can.

docs/hosting.md repeats these lines word for word, and tests/hosts runs the real servers with them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping

NGINX = r"""
location ~ \.lpc$ {
    root /srv/models;
    gzip off;
    default_type application/octet-stream;
    keepalive_timeout 75s;
    keepalive_requests 100000;
    add_header Cache-Control "public, max-age=10" always;
    add_header Access-Control-Allow-Origin "*" always;
    add_header Access-Control-Expose-Headers "Accept-Ranges, Content-Range, ETag" always;
    if ($request_method = OPTIONS) {
        add_header Access-Control-Allow-Origin "*";
        add_header Access-Control-Allow-Methods "GET, HEAD";
        add_header Access-Control-Allow-Headers "Authorization, If-Match, Range";
        return 204;
    }
}
"""

APACHE = r"""
# a2enmod headers setenvif
KeepAlive On
KeepAliveTimeout 75
MaxKeepAliveRequests 0
<Directory /srv/models>
    Require all granted
</Directory>
SetEnvIf Request_URI "\.lpc$" no-gzip no-brotli
<FilesMatch "\.lpc$">
    ForceType application/octet-stream
    FileETag MTime Size
    Header always set Cache-Control "public, max-age=10"
    Header always set Access-Control-Allow-Origin "*"
    Header always set Access-Control-Allow-Methods "GET, HEAD"
    Header always set Access-Control-Allow-Headers "Authorization, If-Match, Range"
    Header always set Access-Control-Expose-Headers "Accept-Ranges, Content-Range, ETag"
</FilesMatch>
"""

CADDY = r"""
root * /srv/models
@models path *.lpc
header @models Cache-Control "public, max-age=10"
header @models Access-Control-Allow-Origin "*"
header @models Access-Control-Allow-Methods "GET, HEAD"
header @models Access-Control-Allow-Headers "Authorization, If-Match, Range"
header @models Access-Control-Expose-Headers "Accept-Ranges, Content-Range, ETag"
@preflight {
    method OPTIONS
    path *.lpc
}
respond @preflight 204
file_server
"""

S3 = r"""
aws s3 cp david.lpc s3://BUCKET/david.lpc --content-type application/octet-stream --cache-control "public, max-age=10"
aws s3api put-bucket-cors --bucket BUCKET --cors-configuration '{"CORSRules": [{
    "AllowedOrigins": ["*"], "AllowedMethods": ["GET", "HEAD"],
    "AllowedHeaders": ["Authorization", "If-Match", "Range"],
    "ExposeHeaders": ["Accept-Ranges", "Content-Range", "ETag"], "MaxAgeSeconds": 86400}]}'
"""

OURS = """
pointstream serve /srv/models --cors "*"
"""

RECIPES: Mapping[str, str] = {"nginx": NGINX, "Apache": APACHE, "Caddy": CADDY, "S3-compatible stores": S3}
"""Lines by kind of host."""

_ALL = {**RECIPES, "pointstream": OURS}

_KNOWN = {
    "pointstream": "pointstream", "nginx": "nginx", "openresty": "nginx", "apache": "Apache", "caddy": "Caddy",
    "amazons3": "S3-compatible stores", "minio": "S3-compatible stores", "ceph": "S3-compatible stores",
}  # fmt: skip


def recipes_for(server: str | None) -> Mapping[str, str]:
    """Recipes of the host that a Server field names; all of them where it names none that we know."""
    named = (server or "").lower()
    kind = next((kind for word, kind in _KNOWN.items() if word in named), None)
    return RECIPES if kind is None else {kind: _ALL[kind]}
