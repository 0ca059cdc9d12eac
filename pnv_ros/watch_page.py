"""The page of pnv_view: the latest match, scores against the bar, which time came back when, path and closures."""

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
<section><h2>which time (across) came back to which (up), s</h2><canvas id="times"></canvas></section>
<section><h2>keyframes and closures between them: metres with odometry, else along time</h2><canvas id="map"></canvas>
</section></main>
<script>
const YES="#009e73",NO="#8a94a0",$=id=>document.getElementById(id);
function ticks(low,high){
  const raw=(high-low)/5||1,power=10**Math.floor(Math.log10(raw)),step=power*[1,2,5,10].find(k=>k*power>=raw),t=[];
  for(let v=Math.ceil(low/step)*step;v<=high+1e-9;v+=step)t.push(+v.toPrecision(6));
  return t}
function plot(canvas,points,low,high,bar,lines=[]){
  const w=canvas.width=canvas.clientWidth*devicePixelRatio,h=canvas.height=w*.55,c=canvas.getContext("2d");
  const font=12*devicePixelRatio,left=4*font,bottom=h-2*font,ink=getComputedStyle(document.body).color;
  const x=v=>left+(v-low[0])/Math.max(high[0]-low[0],1e-9)*(w-left-font);
  const y=v=>bottom-(v-low[1])/Math.max(high[1]-low[1],1e-9)*(bottom-font);
  c.font=font+"px system-ui";c.fillStyle=ink;c.strokeStyle=NO;
  for(const a of ticks(low[0],high[0]))c.fillText(a,Math.min(x(a),w-2*font),h-font/2);
  for(const b of ticks(low[1],high[1]))c.fillText(b,0,y(b)+font/3);
  if(bar!==undefined){c.beginPath();c.moveTo(left,y(bar));c.lineTo(w,y(bar));c.stroke()}
  for(const p of points){c.fillStyle=p[2]?YES:NO;c.beginPath();c.arc(x(p[0]),y(p[1]),font/3.5,0,7);c.fill()}
  c.strokeStyle=YES;c.lineWidth=devicePixelRatio;
  for(let i=0;i+1<lines.length;i+=2){
    c.beginPath();c.moveTo(x(lines[i][0]),y(lines[i][1]));c.lineTo(x(lines[i+1][0]),y(lines[i+1][1]));c.stroke()}
}
function plan(canvas,keyframes,closures){ // along the two axes where the path extends most, to one scale
  const all=keyframes.concat(closures),low=[0,1,2].map(i=>Math.min(...all.map(p=>p[i])));
  const high=[0,1,2].map(i=>Math.max(...all.map(p=>p[i]))),span=i=>high[i]-low[i];
  const [a,b]=[0,1,2].sort((i,j)=>span(j)-span(i)).slice(0,2).sort(),flat=p=>[p[a],p[b]];
  const tall=(canvas.clientWidth*.55-36)/(canvas.clientWidth-60),at=i=>(low[i]+high[i])/2;
  const x=Math.max(span(a),span(b)/tall,1)*.55,y=x*tall;
  plot(canvas,keyframes.map(flat),[at(a)-x,at(b)-y],[at(a)+x,at(b)+y],undefined,closures.map(flat))}
async function look(){try{
  const s=await (await fetch("state.json")).json(),q=s.queries,v=s.values;
  $("words").textContent=s.message;$("words").style.color=s.level?"#d55e00":"";
  $("values").textContent=["frames processed [1/s]","keyframes","closures","memory [MB]"]
    .filter(k=>k in v).map(k=>k+" "+v[k]).join(" · ");
  if(q.length){
    const start=Math.min(...q.map(p=>Math.min(p[0],p[1]))),end=Math.max(...q.map(p=>p[0]))-start;
    plot($("scores"),q.map(p=>[p[0]-start,p[2],p[3]]),[0,0],[end,1],+v["accept_score"]);
    plot($("times"),q.map(p=>[p[0]-start,p[1]-start,p[3]]),[0,0],[end,end]);
    if(s.map.keyframes.length)plan($("map"),s.map.keyframes,s.map.closures);
    const picture=new Image();picture.onload=()=>$("match").src=picture.src;picture.src="match.jpg?"+Date.now();
  }}catch(e){$("words").textContent="pnv_view does not answer"}
  setTimeout(look,1000)}
look();
</script></html>
"""
