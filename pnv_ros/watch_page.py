"""The page of pnv_view: the latest match, the score of every query against the bar, which time came back when."""

PAGE = """<!doctype html><html lang="en"><meta charset="utf-8">
<meta name="viewport" content="width=device-width,initial-scale=1"><title>place_recognizer</title>
<style>
:root{color-scheme:light dark;--ink:#1c2430;--soft:#5c6672;--paper:#fff;--line:#d7dce2;--panel:#f4f6f8}
@media(prefers-color-scheme:dark){:root{--ink:#e8ecf0;--soft:#a2adb8;--paper:#14181d;--line:#38414b;--panel:#1d232a}}
body{margin:0;background:var(--paper);color:var(--ink);font:16px/1.4 system-ui,sans-serif}
main{max-width:1120px;margin:auto;padding:12px;display:grid;gap:12px;
grid-template-columns:repeat(auto-fit,minmax(min(100%,420px),1fr))}
header,section{background:var(--panel);border:1px solid var(--line);border-radius:8px;padding:10px}
header{grid-column:1/-1}h1{font-size:1rem;margin:0}h2{font-size:.9rem;margin:0 0 6px;color:var(--soft)}
img,canvas{width:100%;display:block}p{margin:4px 0 0;color:var(--soft);font-variant-numeric:tabular-nums}
</style><main><header><h1 id="words">waiting</h1><p id="values"></p></header>
<section><h2>query and best candidate</h2><img id="match" alt="no match image yet"></section>
<section><h2>score of the best candidate over time; the line is the bar</h2><canvas id="scores"></canvas></section>
<section><h2>which time (across) came back to which (up), s</h2><canvas id="times"></canvas></section></main>
<script>
const YES="#009e73",NO="#8a94a0",$=id=>document.getElementById(id);
function plot(canvas,points,low,high,bar){
  const w=canvas.width=canvas.clientWidth*devicePixelRatio,h=canvas.height=w*.55,c=canvas.getContext("2d");
  const font=12*devicePixelRatio,left=4*font,bottom=h-2*font,ink=getComputedStyle(document.body).color;
  const x=v=>left+(v-low[0])/Math.max(high[0]-low[0],1e-9)*(w-left-font);
  const y=v=>bottom-(v-low[1])/Math.max(high[1]-low[1],1e-9)*(bottom-font);
  c.font=font+"px system-ui";c.fillStyle=ink;c.strokeStyle=NO;
  for(let i=0;i<=4;i++){const a=low[0]+(high[0]-low[0])*i/4,b=low[1]+(high[1]-low[1])*i/4;
    c.fillText(a.toPrecision(3)/1,x(a)-(i==4?2*font:0),h-font/2);c.fillText(b.toPrecision(3)/1,0,y(b)+font/3)}
  if(bar!==undefined){c.beginPath();c.moveTo(left,y(bar));c.lineTo(w,y(bar));c.stroke()}
  for(const p of points){c.fillStyle=p[2]?YES:NO;c.beginPath();c.arc(x(p[0]),y(p[1]),font/3.5,0,7);c.fill()}
}
async function look(){try{
  const s=await (await fetch("state.json")).json(),q=s.queries,v=s.values;
  $("words").textContent=s.message;$("words").style.color=s.level?"#d55e00":"";
  $("values").textContent=["frames processed [1/s]","keyframes","closures","memory [MB]"]
    .filter(k=>k in v).map(k=>k+" "+v[k]).join(" · ");
  if(q.length){
    const start=Math.min(...q.map(p=>Math.min(p[0],p[1]))),end=Math.max(...q.map(p=>p[0]))-start;
    plot($("scores"),q.map(p=>[p[0]-start,p[2],p[3]]),[0,0],[end,1],+v["accept_score"]);
    plot($("times"),q.map(p=>[p[0]-start,p[1]-start,p[3]]),[0,0],[end,end]);
    const picture=new Image();picture.onload=()=>$("match").src=picture.src;picture.src="match.jpg?"+Date.now();
  }}catch(e){$("words").textContent="pnv_view does not answer"}
  setTimeout(look,1000)}
look();
</script></html>
"""
