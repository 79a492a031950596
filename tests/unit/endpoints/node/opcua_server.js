// Serves the nodes that a file describes, as an S7-1500 names them; prints its port, and ends with its standard input.
// Usage: node opcua_server.js PORT FOLDER NODES.json [secured]; a node is {"id", "type", "value", "writable"}.
// With {"id", "structure", "value"}, a node is a structure of opcua_structures.xml, or an array of them.
// A secured server also has an encrypted endpoint, and rejects there clients whose certificates are not in its folder.
// It admits users whose certificates are in the folder "users" beside that.
'use strict';

const fs = require('fs');
const path = require('path');
const opcua = require('node-opcua-server');
const { DataType, MessageSecurityMode, SecurityPolicy, VariantArrayType } = require('node-opcua-client');
const { OPCUACertificateManager } = require('node-opcua-certificate-manager');
const { nodesets } = require('node-opcua-nodesets');

const [port, folder, file, secured] = process.argv.slice(2);

const nodes = JSON.parse(fs.readFileSync(file));
const structures = nodes.some((one) => one.structure) ? [path.join(__dirname, 'opcua_structures.xml')] : [];

async function main() {
  const certificates = new OPCUACertificateManager({ rootFolder: folder, automaticallyAcceptUnknownCertificate: !secured });
  await certificates.initialize();
  const users = new OPCUACertificateManager({ rootFolder: `${path.dirname(folder)}/users` });
  await users.initialize();
  const server = new opcua.OPCUAServer({
    port: Number(port),
    hostname: '127.0.0.1',
    securityModes: [MessageSecurityMode.None, ...(secured ? [MessageSecurityMode.SignAndEncrypt] : [])],
    securityPolicies: [SecurityPolicy.None, ...(secured ? [SecurityPolicy.Basic256Sha256] : [])],
    serverCertificateManager: certificates,
    userCertificateManager: users,
    disableDiscovery: true,
    nodeset_filename: [nodesets.standard, ...structures],
  });
  await server.initialize();
  const space = server.engine.addressSpace;
  space.registerNamespace('http://test/other');
  const names = space.registerNamespace('http://www.siemens.com/simatic-s7-opcua');
  const device = names.addObject({ organizedBy: space.rootFolder.objects, browseName: 'PLC', nodeId: 's=PLC' });
  for (const { id, type, value, writable, structure } of nodes) {
    if (structure) {
      const dataType = space.findDataType(structure, space.getNamespaceIndex('http://test/structures'));
      const made = (one) => space.constructExtensionObject(dataType, one);
      const array = Array.isArray(value);
      names.addVariable({
        componentOf: device, browseName: id, nodeId: `s=${id}`, dataType: dataType.nodeId, valueRank: array ? 1 : -1,
        value: {
          dataType: DataType.ExtensionObject, arrayType: array ? VariantArrayType.Array : VariantArrayType.Scalar,
          value: array ? value.map(made) : made(value),
        },
      });
      continue;
    }
    const dataType = DataType[type];
    const array = Array.isArray(value) && type !== 'Int64'; // one is [high, low]
    const held = type === 'DateTime' ? new Date(value) : value;
    if (array && Array.isArray(value[0])) {
      const dimensions = [value.length, value[0].length];
      names.addVariable({
        componentOf: device, browseName: id, nodeId: `s=${id}`, dataType, valueRank: 2, arrayDimensions: dimensions,
        accessLevel: 'CurrentRead | CurrentWrite',
        value: { dataType, arrayType: VariantArrayType.Matrix, dimensions, value: value.flat() },
      });
      continue;
    }
    const variant = { dataType, arrayType: array ? VariantArrayType.Array : VariantArrayType.Scalar, value: held };
    names.addVariable({
      componentOf: device, browseName: id, nodeId: `s=${id}`, dataType,
      valueRank: array ? 1 : -1, arrayDimensions: array ? [value.length] : undefined,
      accessLevel: writable ? 'CurrentRead | CurrentWrite' : 'CurrentRead',
      value: variant,
    });
  }
  await server.start();
  console.log(JSON.stringify({ port: Number(port), index: names.index }));
  process.stdin.resume();
  process.stdin.on('end', async () => {
    await server.shutdown(0);
    process.exit(0);
  });
}

main().catch((error) => { console.error(error); process.exit(1); });
