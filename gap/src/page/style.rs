//! The page's style sheet: light and dark, screen, telephone and paper.

/// CSS of the page; that of its pictures is [`caudata_chart::style`].
pub const CSS: &str = r#"
:root{color-scheme:light dark;--bg:#fbfaf8;--card:#fff;--line:#e2e0da;
--warn:#a86400;--bad:#b3261e;--note:#4a5560;
--h0:#f3f1ec;--h1:#f6dfc0;--h2:#f0b27a;--h3:#dd7a45;--h4:#b8432a;--h5:#7a1f1f}
@media (prefers-color-scheme:dark){:root{--bg:#14171b;--card:#1c2026;--line:#2d333b;
--warn:#f0b350;--bad:#ff7b72;--note:#aab4c0;
--h0:#22272e;--h1:#4a3a24;--h2:#7d4d22;--h3:#b0602b;--h4:#dd7045;--h5:#ff9d7a}}
*{box-sizing:border-box}
body{margin:0;background:var(--bg);color:var(--ink);font:16px/1.5 system-ui,-apple-system,"Segoe UI",Roboto,"Helvetica Neue",sans-serif}
main{max-width:1120px;margin:0 auto;padding:20px 18px 60px}
h1{font-size:1.5rem;line-height:1.25;margin:.2em 0 .35em;font-weight:650;letter-spacing:-.01em}
h2{font-size:1.12rem;margin:2.4em 0 .5em;font-weight:650}
h3{font-size:1rem;margin:0 0 .2em;font-weight:650}
p{margin:.3em 0 .7em;max-width:72ch}
.soft{color:var(--soft)} .small{font-size:.86rem}
.top{color:var(--soft);font-size:.86rem;margin:0}
.badge{display:inline-block;margin:0 0 .55em;padding:.18em .7em;border-radius:99px;font-weight:650;font-size:.9rem;border:1.5px solid currentColor}
.ok{color:var(--ok)}.warn{color:var(--warn)}.bad{color:var(--bad)}.note{color:var(--note)}
.tiles{display:grid;grid-template-columns:repeat(auto-fit,minmax(150px,1fr));gap:10px;margin:16px 0 4px}
.tile,.card{background:var(--card);border:1px solid var(--line);border-radius:10px;padding:11px 14px}
.tile b{display:block;font-size:1.42rem;line-height:1.2;font-weight:640;font-variant-numeric:tabular-nums}
.tile span{color:var(--soft);font-size:.82rem}
.card{margin:0 0 12px;padding:14px 16px}
.grid{display:grid;grid-template-columns:repeat(auto-fit,minmax(min(100%,430px),1fr));gap:12px}
.grid>.card{margin:0}
.cause .grid{grid-template-columns:repeat(auto-fill,minmax(min(100%,430px),1fr))}
figure{margin:0} figcaption{font-size:.86rem;color:var(--soft);margin:0 0 4px} figcaption b{color:var(--ink);font-weight:620}
svg{display:block;width:100%;height:auto}
.key{display:flex;flex-wrap:wrap;gap:4px 16px;font-size:.84rem;color:var(--soft);margin:2px 0 10px}
.key i{display:inline-block;width:20px;height:0;border-top:2.5px solid;vertical-align:middle;margin-right:6px}
.key .kb{height:11px;border:0;background:var(--band)} .key .kc{border-top:1.5px dashed var(--soft)}
table{border-collapse:collapse;width:100%;font-size:.88rem;font-variant-numeric:tabular-nums}
th{text-align:left;font-weight:600;color:var(--soft);border-bottom:1.5px solid var(--line);padding:4px 10px 4px 0}
td{border-bottom:1px solid var(--line);padding:4px 10px 4px 0;vertical-align:top}
td.r,th.r{text-align:right}
.scroll{overflow-x:auto}
.cause{border-left:4px solid var(--after)}
.cause.amb{border-left-color:var(--warn)}
.conf{display:inline-block;width:110px;height:9px;border-radius:5px;background:var(--grid);overflow:hidden;vertical-align:middle;margin:0 6px}
.conf i{display:block;height:100%;background:var(--after)}
ul{margin:.3em 0 .6em;padding-left:1.15em} li{margin:.15em 0}
details{margin:.4em 0} summary{cursor:pointer;color:var(--soft);font-size:.88rem}
code{font:.9em ui-monospace,SFMono-Regular,Menlo,monospace;background:var(--grid);padding:.05em .35em;border-radius:4px}
.next{border-left:4px solid var(--ok)}
footer{margin-top:40px;color:var(--soft);font-size:.82rem;border-top:1px solid var(--line);padding-top:10px}
@media (max-width:560px){main{padding:14px 11px 40px}h1{font-size:1.22rem}.card{padding:11px 11px}}
@media print{:root{color-scheme:light;--bg:#fff;--card:#fff;--line:#bbb;
--warn:#7a4900;--bad:#8f1d17;--h0:#f3f1ec;--h1:#f6dfc0;--h2:#f0b27a;--h3:#dd7a45;--h4:#b8432a;--h5:#7a1f1f}
body{font-size:11pt}.card,.tile,figure,tr{break-inside:avoid}h2{break-after:avoid}details>*{display:block}main{max-width:none;padding:0}}
"#;
