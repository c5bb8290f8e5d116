// The viewer in a browser: shows the pictures that come through a websocket and sends back what mouse and keys do.
// rendercanvas's renderview.js turns the browser's events into its own; its page and client are not used.

import './renderview.js'

const WATCHING = 'Another browser drives this viewer; this one watches.'
const LOST = 'The connection to lapgs-view was lost: trying again ...'

const image = document.getElementById('picture')
const note = document.getElementById('note')

let socket = null
let drives = false
let pending = null // a message whose picture comes next
let frames = []
let showing = false
let address = null // of the picture on show
let size = null // the last resize event, for whoever drives next
const held = new Set()

// Of several fingers the first one counts: renderview.js takes them all for one pointer, which leaps between them.
for (const name of ['pointerdown', 'pointermove', 'pointerup', 'pointercancel']) {
  window.addEventListener(name, event => { if (!event.isPrimary) { event.stopImmediatePropagation() } }, true)
}

// A file that is dropped here would take the place of the viewer.
for (const name of ['dragover', 'drop']) {
  window.addEventListener(name, event => event.preventDefault())
}

class View extends window.BaseRenderView {
  onEvent (event) {
    if (event.type === 'resize') {
      size = event
    } else if (event.type === 'key_down') {
      held.add(event.key)
    } else if (event.type === 'key_up') {
      held.delete(event.key)
    }
    send(event)
  }
}

function send (event) {
  if (drives && socket !== null && socket.readyState === WebSocket.OPEN) {
    socket.send(JSON.stringify(event))
  }
}

function say (text) {
  note.textContent = text
}

// One picture a repaint; the server learns of it once it is on show, and goes no faster than that.
async function show () {
  if (showing || frames.length === 0) { return }
  showing = true
  const { from, index, timestamp, blob } = frames.shift()
  const before = address
  address = URL.createObjectURL(blob)
  image.src = address
  try {
    await image.decode()
  } catch { } // a picture that comes after it replaces it
  if (before !== null) { URL.revokeObjectURL(before) }
  if (from === socket && from.readyState === WebSocket.OPEN) {
    from.send(JSON.stringify({ type: '_framefeedback', index, timestamp }))
    say(drives ? '' : WATCHING)
  }
  window.requestAnimationFrame(() => { showing = false; show() })
}

function receive (ws, data) {
  if (data instanceof Blob) {
    if (pending !== null) {
      frames.push({ ...pending, from: ws, blob: new Blob([data], { type: pending.mimetype }) })
      pending = null
      show()
    }
    return
  }
  const message = JSON.parse(data)
  if (message.type === 'framebufferdata') {
    pending = message
  } else if (message.type === 'active') {
    drives = message.value
    say(drives ? '' : WATCHING)
    if (size !== null) { send(size) } // the server forgets sizes of those who only watch
  } else if (message.type === 'cursor') {
    view.setCursor(message.value)
  }
}

function connect () {
  const path = window.location.pathname.replace(/[^/]*$/, '') + 'ws'
  const ws = new WebSocket((window.location.protocol === 'https:' ? 'wss://' : 'ws://') + window.location.host + path)
  ws.onopen = () => {
    socket = ws
    pending = null
    frames = []
  }
  ws.onmessage = (event) => receive(ws, event.data)
  ws.onclose = () => {
    socket = null
    drives = false
    held.clear()
    say(LOST)
    window.setTimeout(connect, 1000)
  }
}

// The token has become a cookie; it need not stay in the address and the history.
window.history.replaceState(null, '', window.location.pathname)

image.style.width = image.style.height = '100%' // renderview sets its own where these are missing
image.decoding = 'sync'
image.ondragstart = () => false
const view = new View(image, null)
// renderview would hold a move back for some milliseconds, past the release of the button that it came before. Browsers
// give no more moves than they repaint, and the server takes those together that it could not draw in between.
view.setThrottle(0)

// Keys count from the start, without a click, and none stays down when its release goes to another window.
const focus = () => view._focusElement.focus({ preventScroll: true })
focus()
window.addEventListener('focus', focus)
window.addEventListener('blur', () => {
  for (const key of held) { send({ type: 'key_up', key, modifiers: [], timestamp: performance.now() / 1000 }) }
  held.clear()
})
// Tab would move the focus, Alt open the browser's menu.
for (const kind of ['keydown', 'keyup']) {
  window.addEventListener(kind, (event) => {
    if (event.key === 'Tab' || event.key === 'Alt') { event.preventDefault() }
  }, true)
}

connect()
