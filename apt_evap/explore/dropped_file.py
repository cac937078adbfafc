"""What the browser does with a file that is dropped on any page: it sends it to the server, which opens it."""

from bokeh.models import CustomJS

DROPPED, TOLD = "dropped", "told of a dropped file"
"""Names of the widgets of a dropped file: its path, and what is told of it."""
# the browser sends a dropped file to the server, which puts it into its folder; the widgets are those of the page that
# is shown then
DROP = CustomJS(
    args={"dropped": DROPPED, "told": TOLD},
    code="""
if (window.apt_evap_drop) return
window.apt_evap_drop = true
// the last one: Bokeh keeps the widgets of pages before
const widget = name => [...Bokeh.documents[0].all_models].filter(model => model.name == name).at(-1)
const tell = text => {
  const place = document.createElement("span")
  place.textContent = text
  widget(told).setv({text: place.innerHTML, visible: true})
}
const send = file => {
  const query = new URLSearchParams(location.search)
  query.set("name", file.name)
  const request = new XMLHttpRequest()
  request.open("POST", "upload?" + query)
  request.upload.onprogress = event => tell(`copying ${file.name}: ${Math.round(100 * event.loaded / event.total)} %`)
  request.onload = () => {
    if (request.status != 200) { tell(request.responseText); return }
    const path = widget(dropped)
    path.value = ""  // the same file again
    path.value = request.responseText
  }
  request.onerror = () => tell("the explorer cannot be reached")
  request.send(file)
}
document.addEventListener("dragover", event => event.preventDefault())
document.addEventListener("drop", event => {
  event.preventDefault()
  if (event.dataTransfer.files.length) send(event.dataTransfer.files[0])
})
""",
)
"""What the browser does when the first page of a document is there."""
