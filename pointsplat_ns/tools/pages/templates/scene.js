const data = JSON.parse(document.getElementById("data").textContent);
const flight = new (data.flight.kept ? Live : Flight)(document.getElementById("flight"), data.flight);
if (self === top) document.querySelector("canvas").focus({ preventScroll: true });
else document.documentElement.className = "framed"; // a part of another page, which keeps the keys until it is clicked
