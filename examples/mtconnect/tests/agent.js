// An MTConnect agent for the tests, written from the public standard (parts 1 to 3, version 1.3 to 2.x).
// It shares no code with the connector. It prints its port, and takes one command in JSON per line on its
// standard input, answering "ok" to each: {"set": {"Xact": "1.5"}, "at": "…"}, {"restart": true},
// {"parts": [bytes of the stream, milliseconds between its bytes]}, {"drip": "headers" or "content"},
// {"silent": true}, {"condition": [id, element, code, text]}, {"version": "1.3"}, {"buffer": 100}, {"raw": [begin, repeated, times]}.
'use strict'
const http = require('http')
const readline = require('readline')

let version = '2.0'
let instanceId = 1000
let sequence = 1
let buffer = []
let limit = 10000
let silent = false
let raw = null
let parts = null
let drip = false
let counted = 0
const state = {}
const active = {} // conditions by data item: {code: observation}

const ITEMS = {
  count: ['Events', 'PartCount'],
  copy: ['Samples', 'Position'],
  Xact: ['Samples', 'Position'],
  Yact: ['Samples', 'Position'],
  exec: ['Events', 'Execution'],
  prog: ['Events', 'Program'],
  door: ['Events', 'DoorState'],
  pos: ['Samples', 'PathPosition'],
  vib: ['Samples', 'AccelerationTimeSeries'],
  set: ['Events', 'VariableDataSet'],
  hyd: ['Condition', '']
}

const escape = text => String(text).replace(/[&<>"]/g, c => ({ '&': '&amp;', '<': '&lt;', '>': '&gt;', '"': '&quot;' })[c])

function add (id, element, text, at, code) {
  const one = { id, element, text, at: at || new Date().toISOString(), code: code || '', sequence: sequence++ }
  buffer.push(one)
  while (buffer.length > limit) buffer.shift()
  if (ITEMS[id][0] !== 'Condition') { state[id] = one; return }
  const known = active[id] || (active[id] = {})
  if (element === 'Unavailable' || (element === 'Normal' && !one.code)) for (const key of Object.keys(known)) delete known[key]
  if (element === 'Normal' && one.code) { delete known[one.code]; if (!Object.keys(known).length) known[''] = { ...one, code: '' } } else { delete known['']; known[one.code] = one }
}

function begin () {
  sequence = 1
  buffer = []
  for (const id of Object.keys(ITEMS)) add(id, id === 'hyd' ? 'Unavailable' : ITEMS[id][1], id === 'hyd' ? '' : 'UNAVAILABLE')
}

const first = () => buffer.length ? buffer[0].sequence : sequence

function header (kind, next) {
  const ns = `urn:mtconnect.org:MTConnect${kind}:${version}`
  const sequences = kind === 'Streams' ? ` firstSequence="${first()}" lastSequence="${sequence - 1}" nextSequence="${next}"` : ''
  return `<?xml version="1.0" encoding="UTF-8"?>\n<MTConnect${kind} xmlns:m="${ns}" xmlns="${ns}" ` +
    'xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance">\n' +
    `<Header creationTime="${new Date().toISOString()}" sender="test" instanceId="${instanceId}" version="${version}" ` +
    `bufferSize="${limit}"${sequences}/>\n`
}

function devices () {
  const item = (id, category, type, more) => `<DataItem id="${id}" category="${category}" type="${type}" ${more || ''}/>`
  return header('Devices') + '<Devices><Device id="d1" name="VMC" uuid="vmc-1"><Description manufacturer="none"/>' +
    `<DataItems>${item('avail', 'EVENT', 'AVAILABILITY')}</DataItems><Components>` +
    '<Axes id="ax" name="base"><Components>' +
    `<Linear id="x" name="X"><DataItems>${item('Xact', 'SAMPLE', 'POSITION', 'name="act" subType="ACTUAL" units="MILLIMETER"')}</DataItems></Linear>` +
    `<Linear id="y" name="Y"><DataItems>${item('Yact', 'SAMPLE', 'POSITION', 'name="act" subType="ACTUAL" units="MILLIMETER"')}</DataItems></Linear>` +
    '</Components></Axes><Controller id="ct" name="controller"><Components><Path id="pt" name="path"><DataItems>' +
    item('exec', 'EVENT', 'EXECUTION') + item('prog', 'EVENT', 'PROGRAM', 'name="program"') + item('count', 'EVENT', 'PART_COUNT') +
    item('copy', 'SAMPLE', 'POSITION', 'name="copy"') + item('pos', 'SAMPLE', 'PATH_POSITION', 'units="MILLIMETER_3D"') +
    item('door', 'EVENT', 'DOOR_STATE') + item('vib', 'SAMPLE', 'ACCELERATION', 'representation="TIME_SERIES"') +
    item('set', 'EVENT', 'VARIABLE', 'representation="DATA_SET"') + item('hyd', 'CONDITION', 'SYSTEM') +
    '</DataItems></Path></Components></Controller></Components></Device></Devices></MTConnectDevices>\n'
}

function streams (observations, next) {
  const groups = { Samples: '', Events: '', Condition: '' }
  for (const one of observations) {
    const more = (one.code ? ` nativeCode="${escape(one.code)}"` : '') + (one.id === 'hyd' ? ' type="SYSTEM"' : '') +
      (one.id === 'vib' && one.text !== 'UNAVAILABLE' ? ` sampleCount="${one.text.split(' ').length}"` : '')
    const content = one.id === 'set' && one.text !== 'UNAVAILABLE' ? `<Entry key="a">${escape(one.text)}</Entry>` : escape(one.text)
    groups[ITEMS[one.id][0]] += `<${one.element} dataItemId="${one.id}" timestamp="${one.at}" sequence="${one.sequence}"${more}>${content}</${one.element}>\n`
  }
  const inside = Object.entries(groups).filter(([, text]) => text).map(([name, text]) => `<${name}>${text}</${name}>`).join('')
  return header('Streams', next) + '<Streams><DeviceStream name="VMC" uuid="vmc-1"><ComponentStream component="Path" componentId="pt">' +
    inside + '</ComponentStream></DeviceStream></Streams></MTConnectStreams>\n'
}

const failure = (code, text) => header('Error') + `<Errors><Error errorCode="${code}">${text}</Error></Errors></MTConnectError>\n`

function since (from, count) {
  const found = buffer.slice(Math.max(0, from - first())).slice(0, count)
  return [found, found.length ? found[found.length - 1].sequence + 1 : from]
}

function dribble (response, text, pause) {
  let at = 0
  const step = pause ? 1 : text.length
  const timer = setInterval(() => { response.write(text.slice(at, at + step)); at += step; if (at >= text.length) clearInterval(timer) }, pause || 1)
  response.on('close', () => clearInterval(timer))
}

function serve (request, response) {
  const url = new URL(request.url, 'http://agent')
  const verb = url.pathname.split('/').pop()
  const number = (name, otherwise) => Number(url.searchParams.get(name) || otherwise)
  const send = (text, status = 200) => { response.writeHead(status, { 'Content-Type': 'text/xml' }); response.end(text) }
  if (drip === 'headers') { dribble(response.socket, 'HTTP/1.1 200 OK\r\nA: ' + ' '.repeat(10000), 20); return }
  if (drip) { response.writeHead(200, { 'Content-Type': 'text/xml' }); dribble(response, ' '.repeat(100000), 20); return }
  if (raw !== null) { response.writeHead(200, { 'Content-Type': 'text/xml' }); response.end(raw); return }
  if (verb === 'probe') { send(devices()); return }
  if (verb === 'current') {
    const present = [...Object.values(state), ...Object.values(active).flatMap(known => Object.values(known))]
    send(streams(present, sequence)); return
  }
  if (verb !== 'sample') { send(failure('UNSUPPORTED', `no ${escape(verb)}`), 404); return }
  let from = number('from', first())
  const count = number('count', 100)
  if (from < first() || from > sequence) { send(failure('OUT_OF_RANGE', `from must be in ${first()} to ${sequence}`), 404); return }
  const boundary = 'part-' + instanceId
  response.writeHead(200, { 'Content-Type': `multipart/x-mixed-replace;boundary=${boundary}` })
  response.socket.setNoDelay(true)
  if (parts !== null) { dribble(response, ...parts); return }
  let sent = 0
  const interval = number('interval', 100)
  const heartbeat = number('heartbeat', 10000)
  const part = text => response.write(`--${boundary}\r\nContent-type: text/xml\r\nContent-length: ${Buffer.byteLength(text)}\r\n\r\n${text}\r\n`)
  const tick = () => {
    if (silent) return
    if (from < first()) { part(failure('OUT_OF_RANGE', 'observations are lost')); response.end(); clearInterval(timer); return }
    if (from > sequence) from = first()
    const [found, next] = since(from, count)
    if (!found.length && Date.now() - sent < heartbeat) return
    sent = Date.now()
    from = next
    part(streams(found, next))
  }
  const timer = setInterval(tick, interval)
  response.on('close', () => clearInterval(timer))
  tick()
}

begin()
const server = http.createServer(serve)
server.keepAliveTimeout = 1000
setInterval(() => {
  if (!counted) return
  add('count', 'PartCount', String(counted))
  add('copy', 'Position', String(counted))
  counted++
}, 2)
server.listen(0, '127.0.0.1', () => console.log(server.address().port))
readline.createInterface({ input: process.stdin }).on('line', line => {
  const command = JSON.parse(line)
  if (command.version) version = command.version
  if (command.buffer) limit = command.buffer
  if (command.count) counted = 1
  if ('silent' in command) silent = command.silent
  if (command.raw) raw = command.raw[0] + command.raw[1].repeat(command.raw[2])
  if (command.parts) parts = command.parts
  if (command.drip) drip = command.drip
  if (command.restart) { instanceId++; begin() }
  for (const [id, text] of Object.entries(command.set || {})) add(id, ITEMS[id][1], text, command.at)
  if (command.condition) { const [id, element, code, text] = command.condition; add(id, element, text, command.at, code) }
  console.log('ok')
}).on('close', () => process.exit(0))
