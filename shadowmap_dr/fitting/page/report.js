// Sliders between two pictures that the page has anyway. Without JavaScript they stay hidden.
for (const place of document.querySelectorAll(".compare")) {
  const images = [place.dataset.first, place.dataset.second].map((id) => {
    const found = document.getElementById(id);
    const image = document.createElement("img");
    image.src = found.src;
    image.alt = found.alt;
    image.className = found.className;
    return image;
  });
  place.querySelector("div").append(...images);
  const slider = place.querySelector("input");
  const show = () => { images[1].style.clipPath = `inset(0 0 0 ${slider.value}%)`; };
  slider.addEventListener("input", show);
  show();
  place.hidden = false;
}
