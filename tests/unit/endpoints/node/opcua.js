// Uses an OPC UA endpoint as a SCADA client does, and prints the result of each step: one JSON object.
// Usage: node opcua.js URL FOLDER INSTANCE [NAME PASSWORD]; with a name, the channel is signed and encrypted.
'use strict';

const opcua = require('node-opcua-client');
const { OPCUACertificateManager } = require('node-opcua-certificate-manager');
const { NumericRange } = require('node-opcua-numeric-range');

const [url, folder, instance, userName, password] = process.argv.slice(2);
const { AttributeIds, MessageSecurityMode, SecurityPolicy, UserTokenType } = opcua;

async function main() {
  const certificates = new OPCUACertificateManager({ rootFolder: folder, automaticallyAcceptUnknownCertificate: true });
  await certificates.initialize();
  const client = opcua.OPCUAClient.create({
    applicationName: 'test',
    endpointMustExist: false,
    connectionStrategy: { maxRetry: 2 },
    clientCertificateManager: certificates,
    securityMode: userName ? MessageSecurityMode.SignAndEncrypt : MessageSecurityMode.None,
    securityPolicy: userName ? SecurityPolicy.Aes256_Sha256_RsaPss : SecurityPolicy.None,
  });
  await client.connect(url);
  const identity = userName ? { type: UserTokenType.UserName, userName, password } : undefined;
  const session = await client.createSession(identity);
  const result = { values: {}, folders: [], types: {} };

  // Browses everything below a node, three references at a time.
  async function browse(nodeId) {
    let found = await session.browse({ nodeId, referenceTypeId: 'HierarchicalReferences', includeSubtypes: true,
      browseDirection: 0, nodeClassMask: 0, resultMask: 63 });
    const references = [...found.references];
    while (found.continuationPoint && found.continuationPoint.length) {
      found = await session.browseNext(found.continuationPoint, false);
      references.push(...found.references);
    }
    return references;
  }
  const variables = [];
  async function walk(nodeId) {
    for (const reference of await browse(nodeId)) {
      const text = reference.nodeId.value.toString();
      if (text.includes('#')) continue;
      if (reference.nodeClass === 2) variables.push(reference.nodeId);
      else { result.folders.push(text); await walk(reference.nodeId); }
    }
  }
  session.requestedMaxReferencesPerNode = 3;
  await walk('ns=2;i=1');
  const path = await session.translateBrowsePath(opcua.makeBrowsePath('ObjectsFolder', `/2:${instance}/2:cell/2:Robot_800`));
  result.path = path.targets[0].targetId.toString();

  const subscription = await session.createSubscription2({ requestedPublishingInterval: 50, requestedLifetimeCount: 1000,
    requestedMaxKeepAliveCount: 10, maxNotificationsPerPublish: 100, publishingEnabled: true, priority: 1 });
  const item = await subscription.monitor({ nodeId: 'ns=2;s=cell/Outputs', attributeId: AttributeIds.Value },
    { samplingInterval: 20, queueSize: 10, discardOldest: true }, 3);
  const seen = new Promise((resolve) => item.on('changed', (value) => { if (value.value.value[13] === 1) resolve('seen'); }));
  const write = async (nodeId, dataType, value) => (await session.write({ nodeId, attributeId: AttributeIds.Value,
    value: { value: { dataType, value } } })).name;
  result.written = await write('ns=2;s=cell/Outputs/13', opcua.DataType.Byte, 1);
  result.change = await seen;
  // Parts of an array, by index ranges.
  const part = { nodeId: 'ns=2;s=cell/Outputs', attributeId: AttributeIds.Value, indexRange: new NumericRange('13:14') };
  const before = (await session.read(part)).value.value;
  const dataType = opcua.DataType.Byte;
  const status = await session.write({ ...part, value: { value: { dataType, arrayType: 1, value: Buffer.from([7, 9]) } } });
  result.part = [before.length, before[0], status.name, ...(await session.read(part)).value.value];
  await session.write({ ...part, value: { value: { dataType, arrayType: 1, value: before } } });
  const beyond = { ...part, indexRange: new NumericRange('9999') };
  result.beyond = (await session.read(beyond)).statusCode.name;
  result.refused = await write('ns=2;s=cell/Robot_800/Axs1_Pos', opcua.DataType.Float, 1.5);
  result.unknown = await write('ns=2;s=cell/nothing', opcua.DataType.Float, 1.5);
  // The cell is paused now: its registers stay the same, apart from its cycle counter.
  const ids = variables.map((nodeId) => ({ nodeId, attributeId: AttributeIds.Value }));
  const still = (values) => JSON.stringify(values.filter((_, index) => variables[index].value !== 'cell/Inputs')
    .map((value) => value.value.value));
  let values = await session.read(ids);
  for (let same = 0; same < 10;) {
    const next = await session.read(ids);
    same = still(next) === still(values) ? same + 1 : 0;
    values = next;
  }
  values.forEach((value, index) => {
    const held = value.value.value;
    result.values[variables[index].value] = held && held.length !== undefined && typeof held !== 'string' ? Array.from(held) : held;
    result.types[variables[index].value] = opcua.DataType[value.value.dataType];
  });
  result.status = values[0].statusCode.name;
  await subscription.terminate();
  await session.close();
  await client.disconnect();
  await certificates.dispose();
  console.log(JSON.stringify(result));
}

main().catch((error) => { console.error(error); process.exit(1); });
