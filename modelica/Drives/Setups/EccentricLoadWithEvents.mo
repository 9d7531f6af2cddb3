within Drives.Setups;
model EccentricLoadWithEvents "Eccentric mass on the output shaft, rotor speed controlled; the gear sticks and slides by events"
  extends EccentricLoad(redeclare model GearModel = Components.EventHarmonicDrive);
end EccentricLoadWithEvents;
