within Drives;
package Signals "Signal blocks: controllers and the normalised bristle"
end Signals;
