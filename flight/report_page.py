"""The frame of the report's page: head and style. Dark text on light, one column on a phone, two on a desk."""

from __future__ import annotations

from html import escape

# The policy forbids everything but what is in the page itself: opening a report never talks to anybody.
_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"

STYLE = """
*{box-sizing:border-box}
body{margin:0 auto;max-width:1180px;padding:16px;background:#fff;color:#1d2430;
 font:16px/1.45 system-ui,-apple-system,"Segoe UI",Roboto,"DejaVu Sans",sans-serif}
h1{font-size:1.5rem;margin:.2em 0}h2{font-size:1.15rem;margin:1.4em 0 .4em;border-bottom:1px solid #d5dae1;padding-bottom:.2em}
header p{margin:.2em 0 1em;padding:.5em .8em;border-left:5px solid #6b7482;background:#f3f5f8;overflow-wrap:anywhere}
header p.good{border-color:#1e8449;background:#eaf6ee}header p.bad{border-color:#c0392b;background:#fbecea}
.figures{display:grid;grid-template-columns:repeat(auto-fill,minmax(150px,1fr));gap:8px;margin:0}
.figures div{background:#f3f5f8;border-radius:6px;padding:8px 10px}
.figures dt{font-size:.8rem;color:#46505e}.figures dd{margin:0;font-weight:600;overflow-wrap:anywhere}
.wide{overflow-x:auto}.wide svg{min-width:720px}
svg{display:block;width:100%;height:auto}
svg text{font:12.5px system-ui,"DejaVu Sans",sans-serif;fill:#303947}
.grid2{display:grid;grid-template-columns:repeat(auto-fit,minmax(min(100%,460px),1fr));gap:12px}
figure{margin:0}figcaption{font-weight:600;font-size:.9rem;margin:.3em 0}
.keys{display:flex;flex-wrap:wrap;gap:4px 16px;font-size:.85rem;margin:.4em 0}
.keys span{white-space:nowrap}.keys i{display:inline-block;width:22px;height:12px;margin-right:5px;vertical-align:-1px}
.scale{font-size:.85rem;margin:.4em 0}.scale i{display:inline-block;width:160px;max-width:45%;height:12px;vertical-align:-1px}
.scroll{overflow-x:auto}table{border-collapse:collapse;width:100%;font-size:.9rem}
th,td{text-align:left;padding:4px 10px 4px 4px;border-bottom:1px solid #e3e6ea;
 font-variant-numeric:tabular-nums;vertical-align:top}
td:nth-child(-n+2),th:nth-child(-n+2){white-space:nowrap}
tr.bad td:last-child{color:#a5281b;font-weight:600}tr.good td:last-child{color:#17693a;font-weight:600}
tr.limited td:last-child{color:#7d5200}
pre{overflow-x:auto;background:#f3f5f8;padding:10px;font-size:.8rem}
.plot{fill:#fcfcfd;stroke:#b9c0ca}.grid{stroke:#e6e9ee;fill:none}
.box{fill:#e3e7ec;stroke:#7d8794}.fence{fill:none;stroke:#c0392b;stroke-width:1.5;stroke-dasharray:7 5}
.goal{fill:#27ae6055;stroke:#1e8449;stroke-width:1.5}.cross{stroke:#1e8449;stroke-width:1.5}
.truth{fill:none;stroke:#111;stroke-width:1;stroke-dasharray:3 3}
.path{fill:none;stroke-width:3.2;stroke-linecap:round;stroke-linejoin:round}
.touched{fill:none;stroke:#f8c471;stroke-width:11;stroke-linecap:round;stroke-linejoin:round}
.stop{fill:none;stroke:#c0392b;stroke-width:2}
.start{fill:#fff;stroke:#111;stroke-width:2}.end{fill:#111}
.wanted{fill:none;stroke:#7b8492;stroke-width:1.4;stroke-dasharray:4 3}.sent{fill:none;stroke:#c2570c;stroke-width:1.8}
.flown{fill:none;stroke:#1f5fbf;stroke-width:1.8}.clear{fill:none;stroke:#1f5fbf;stroke-width:1.8}
.margin{fill:none;stroke:#c0392b;stroke-width:1.8}
.limited{fill:#f8c47155}.braking{fill:#e74c3c55}.bar{fill:#4a6fa5}.mark{stroke:#c0392b;stroke-width:1.5;stroke-dasharray:4 3}
.ahead{stroke:#1d2430;stroke-width:1;stroke-dasharray:2 5}
.k-path{background:linear-gradient(90deg,#2c3e94,#dc4a3d,#f0a202)}.k-touched,.k-limited{background:#f8c471}
.k-stop,.k-braking{background:#e8897f}.k-goal{background:#9fd8b6;border:1.5px solid #1e8449}.k-fence{border:1.5px dashed #c0392b}
.keys .k-truth,.keys .k-wanted,.keys .k-sent,.keys .k-flown,.keys .k-clear,.keys .k-margin{height:0;vertical-align:4px}
.k-truth{border-top:1.5px dashed #111}.k-wanted{border-top:2px dashed #7b8492}.k-sent{border-top:2.5px solid #c2570c}
.k-flown,.k-clear{border-top:2.5px solid #1f5fbf}.k-margin{border-top:2.5px solid #c0392b}
@media (max-width:640px){body{padding:10px}svg text{font-size:16px}.figures{grid-template-columns:1fr 1fr}}
"""


def page(title: str, style: str, body: str) -> str:
    """A whole HTML document."""
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">'
        '<meta name="viewport" content="width=device-width,initial-scale=1"><meta name="color-scheme" content="light">'
        f"<title>{escape(title)}</title><style>{style}</style></head><body>{body}</body></html>\n"
    )
