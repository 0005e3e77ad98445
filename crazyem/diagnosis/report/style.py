"""How a report looks: one style sheet, for screen and paper."""

CSS = """
:root{--ink:#1d2329;--soft:#5d6873;--line:#e3e7eb;--blue:#2f6f9f;--red:#c4532f;--green:#3f7d4f;
--paper:#fff;--back:#f4f6f8}
*{box-sizing:border-box}
body{margin:0;background:var(--back);color:var(--ink);
font:15px/1.5 system-ui,-apple-system,"Segoe UI",Roboto,sans-serif}
main{max-width:880px;margin:0 auto;padding:24px 16px 64px}
header{background:var(--paper);border-radius:10px;border-left:8px solid var(--green);padding:20px 24px;
margin-bottom:18px;box-shadow:0 1px 3px rgba(0,0,0,.08)}
header.differs{border-left-color:var(--red)}
.kicker{margin:0;color:var(--soft);letter-spacing:.08em;text-transform:uppercase;font-size:12px}
h1{font-size:22px;line-height:1.35;margin:6px 0 8px;font-weight:650}
h2{font-size:17px;margin:0 0 12px}
h3{font-size:14.5px;margin:16px 0 6px}
section{background:var(--paper);border-radius:10px;padding:18px 24px 20px;margin-bottom:18px;
box-shadow:0 1px 3px rgba(0,0,0,.08)}
dl.about{display:grid;grid-template-columns:max-content 1fr;gap:2px 14px;margin:10px 0 0;font-size:13px}
dl.about dt{color:var(--soft)}dl.about dd{margin:0;overflow-wrap:anywhere}
.scroll{overflow-x:auto}
table{border-collapse:collapse;width:100%;font-size:13.5px;font-variant-numeric:tabular-nums}
th{color:var(--soft);font-weight:500;text-align:left;border-bottom:1px solid var(--line);padding:4px 10px 4px 0}
td{border-bottom:1px solid var(--line);padding:5px 10px 5px 0;vertical-align:middle;overflow-wrap:anywhere}
tbody tr:last-child td{border-bottom:0}
.r{text-align:right;white-space:nowrap}
small{color:var(--soft)}b.better{color:var(--green)}
.cards{display:grid;gap:14px}
.card{border:1px solid var(--line);border-radius:8px;padding:10px 16px 8px}
.card h3{margin:2px 0 0;font-size:16px}
.evidence{margin:2px 0 8px;color:var(--soft);font-size:13px}
.badge{background:#e6f0f7;color:var(--blue);border-radius:20px;padding:2px 10px;font-size:12px;font-weight:500;
margin-left:6px}
svg.bar{width:130px;height:14px;display:block}
.bar .zero{stroke:#b9c1c8;stroke-width:1;stroke-dasharray:2 1.5;vector-effect:non-scaling-stroke}
.bar .span{stroke:var(--blue);stroke-width:4;opacity:.45;vector-effect:non-scaling-stroke}
.bar .value{stroke:var(--blue);stroke-width:2.5;vector-effect:non-scaling-stroke}
.meter{display:block;width:160px;height:8px;background:var(--back);border-radius:4px;overflow:hidden}
.meter i{display:block;height:100%;background:var(--blue)}
ul{margin:6px 0;padding-left:20px}
ul.warn{list-style:none;padding:0}
ul.warn li{background:#fdf3e1;border-left:4px solid #d9a441;padding:6px 12px;border-radius:4px;margin:10px 0}
figure{margin:16px 0 0}figcaption{font-size:13.5px;font-weight:600;margin-bottom:4px}
figure img{width:100%;height:auto;display:block}
@media print{body{background:#fff}section,header{box-shadow:none;border:1px solid var(--line);break-inside:avoid}}
"""
