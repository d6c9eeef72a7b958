// A click on an image shows it alone, as large as the window; another click goes back.
const dialog = document.body.appendChild(document.createElement("dialog"));
for (const image of document.querySelectorAll(".layers")) {
  image.addEventListener("click", () => {
    dialog.replaceChildren(image.cloneNode(true));
    dialog.showModal();
  });
}
dialog.addEventListener("click", () => dialog.close());

// What goes on beyond the right edge says so.
for (const box of document.querySelectorAll(".scroll")) {
  const look = () =>
    box.classList.toggle("cut", box.scrollLeft + box.clientWidth < box.scrollWidth - 1);
  new ResizeObserver(look).observe(box);
  box.addEventListener("scroll", look);
}

const PLOTLY_CONFIG = { displaylogo: false, responsive: true, scrollZoom: true };
const views = document.querySelectorAll(".view");

async function loadPlotly() {
  const packed = document.getElementById("plotly").textContent;
  const bytes = Uint8Array.from(atob(packed), (letter) => letter.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  const code = document.createElement("script");
  code.textContent = await new Response(stream).text();
  document.head.append(code);
}

async function drawView(view) {
  const element = view.querySelector(".scene");
  const scene = JSON.parse(view.querySelector("script").textContent);
  const buttons = view.querySelectorAll("button");
  element.textContent = "";
  view.classList.add("drawn");
  await Plotly.newPlot(element, scene.data, scene.layout, PLOTLY_CONFIG);
  buttons.forEach((button, chosen) => button.addEventListener("click", () => {
    const [cloud, ...others] = scene.data;
    const marker = { ...cloud.marker, ...scene.layout.meta[chosen].marker };
    // What a click in the legend has hidden or shown stays so.
    const data = [{ ...cloud, marker }, ...others].map(
      (trace, n) => ({ ...trace, visible: element.data[n].visible })
    );
    Plotly.react(element, data, element.layout, PLOTLY_CONFIG);
    buttons.forEach((other) => other.setAttribute("aria-pressed", other === button));
  }));
}

if (views.length) {
  loadPlotly().then(() => Promise.all([...views].map(drawView))).catch((error) => {
    for (const view of views) {
      view.classList.remove("drawn");
      view.querySelector(".scene").textContent = "No view in 3-D to turn here: " + error;
    }
  });
}
