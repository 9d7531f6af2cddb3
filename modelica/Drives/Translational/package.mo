within Drives;
package Translational "Components of a linear axis"
end Translational;
